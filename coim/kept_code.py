"""Compiled code of functions of coim that outlives the process: kept where Inductor keeps what it compiles.

Code is found again only where all that it was made from is the same: every source file of coim, the versions of Python
and torch, Inductor's settings, the sizes of the inputs and the number of threads. Kept code that cannot be read, or
whose guards refuse the inputs, is compiled anew.
"""

from __future__ import annotations

import functools
import hashlib
import os
import sys
import tempfile
import time
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

import torch

PACKAGE = Path(__file__).parent
_IMPORTED = time.time()


def kept(
    function: Callable[..., Any], made_for: Hashable, args: tuple[Any, ...], kwargs: dict[str, Any]
) -> Callable[..., Any] | None:
    """The code that `keep` has kept, or None.

    Args:
        function: of the package coim; nothing is kept of others.
        made_for: all that the code depends on, beside what this module knows of.
        args: the inputs, which the code's guards must accept.
        kwargs: likewise.
    """
    path = _path(function, made_for)
    if path is None or not path.exists():
        return None
    try:
        # The compiler's vector instructions were probed when this was compiled; a probe takes a second or two.
        with path.open("rb") as file, torch._inductor.config.patch({"cpp.vec_isa_ok": True}):
            code: Any = torch.compiler.load_compiled_function(file, f_globals=function.__globals__)
        return code if code.guard_check(*args, **kwargs) else None
    except Exception:  # half a file, another layout, a compiler that is gone: anything may be wrong
        return None


def keep(code: Any, function: Callable[..., Any], made_for: Hashable) -> None:
    """Keep code for later processes, where the disk has room for it.

    Args:
        code: as `torch.compile(...).aot_compile` returns it.
        function: what it was compiled from; nothing is kept of functions that are not of coim.
        made_for: as in `kept`.
    """
    path = _path(function, made_for)
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as beside:
            code.save_compiled_function(f"{beside}/{path.name}")
            os.replace(f"{beside}/{path.name}", path)
    except Exception:  # a full disk, or code that this torch cannot write: the run has what it needs
        return


def _path(function: Callable[..., Any], made_for: Hashable) -> Path | None:
    """Where the code lies, or None if nothing says what it would have been made from."""
    if function.__module__.split(".")[0] != PACKAGE.name:
        return None
    sources = _digest_of_sources()
    if sources is None:
        return None
    from torch._inductor.runtime.cache_dir_utils import cache_dir

    settings = sorted(torch._inductor.config.save_config_portable().items())
    torch_is = torch.__version__, torch.version.git_version, torch.backends.cpu.get_cpu_capability()
    made_from = (made_for, sources, sys.version, torch_is, settings)
    return Path(cache_dir()) / PACKAGE.name / hashlib.sha256(repr(made_from).encode()).hexdigest()


@functools.cache
def _digest_of_sources() -> str | None:
    """A digest of all source files of coim, or None if one was changed while this process had it already."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.stat().st_ctime > _IMPORTED:
            return None
        digest.update(str(path.relative_to(PACKAGE)).encode() + path.read_bytes())
    return digest.hexdigest()
