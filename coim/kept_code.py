"""Compiled code of functions of coim that outlives the process: kept where Inductor keeps what it compiles.

Code is found again only where all that it was made from is the same: the functions and constants that the function
reaches, as this process holds them, the versions of Python and torch, Inductor's settings, the sizes of the inputs and
the number of threads. Kept code that cannot be read, or whose guards refuse the inputs, is compiled anew. The files may
be deleted at any time.
"""

from __future__ import annotations

import hashlib
import logging
import os
import sys
import tempfile
from collections.abc import Callable, Hashable, Iterator
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import torch

PACKAGE = __name__.split(".")[0]
LOG = logging.getLogger(__name__)
PLAIN = (int, float, complex, str, bytes, bool, type(None), torch.dtype)


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
    if not _is_of_coim(function):
        return None
    try:
        path = _path(made_for)
        if not path.exists():
            return None
        with path.open("rb") as file:
            code: Any = torch.compiler.load_compiled_function(file, f_globals=function.__globals__)
        return code if code.guard_check(*args, **kwargs) else None
    except Exception:  # half a file, another layout, a compiler that is gone: anything may be wrong
        LOG.debug("kept code of %s cannot be taken", function.__name__, exc_info=True)
        return None


def keep(code: Any, function: Callable[..., Any], made_for: Hashable) -> None:
    """Keep code for later processes, where the disk has room for it.

    Args:
        code: as `torch.compile(...).aot_compile` returns it.
        function: what it was compiled from; nothing is kept of functions that are not of coim.
        made_for: as in `kept`.
    """
    if not _is_of_coim(function):
        return
    try:
        path = _path(made_for)
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as beside:
            code.save_compiled_function(f"{beside}/{path.name}")
            os.replace(f"{beside}/{path.name}", path)
    except Exception:  # a full disk, or code that this torch cannot write: the run has what it needs
        LOG.debug("code of %s cannot be kept", function.__name__, exc_info=True)


def fingerprint(function: Callable[..., Any]) -> str:
    """A digest of what a function does: its own code, and that of all functions and constants of coim that it reaches.

    They are taken as this process holds them, and not from their files: whoever replaces one has another function.

    Example:
        >>> def one(x): return x + 1
        >>> def other(x): return x + 2
        >>> fingerprint(one) == fingerprint(one), fingerprint(one) == fingerprint(other)
        (True, False)
    """
    return hashlib.sha256("\n".join(_parts(function, set())).encode()).hexdigest()


def folder() -> Path:
    """Where compiled code of coim lies: in the folder of what Inductor compiles."""
    from torch._inductor.runtime.cache_dir_utils import cache_dir

    return Path(cache_dir()) / PACKAGE


def _is_of_coim(function: Callable[..., Any]) -> bool:
    return function.__module__.split(".")[0] == PACKAGE


def _path(made_for: Hashable) -> Path:
    """Where the code lies."""
    settings = sorted(torch._inductor.config.save_config_portable().items())
    torch_is = torch.__version__, torch.version.git_version, torch.backends.cpu.get_cpu_capability()
    made_from = (made_for, sys.version, torch_is, settings)
    return folder() / hashlib.sha256(repr(made_from).encode()).hexdigest()


def _parts(value: Any, seen: set[int]) -> Iterator[str]:
    """What a value is made of, in words that are the same in every process."""
    if isinstance(value, (FunctionType, type, ModuleType)):
        yield f"{type(value).__name__} {value.__name__}"
        if id(value) in seen:
            return
        seen.add(id(value))
    if isinstance(value, FunctionType):
        yield from _parts((value.__defaults__, value.__kwdefaults__), seen)
        yield from _parts(tuple(cell.cell_contents for cell in value.__closure__ or ()), seen)
        yield from _parts_of_code(value.__code__, value.__globals__, seen)
    elif isinstance(value, type):
        if value.__module__.split(".")[0] == PACKAGE:
            for name, part in vars(value).items():
                if isinstance(part, (FunctionType, tuple, *PLAIN)) and name not in ("__doc__", "__module__"):
                    yield name
                    yield from _parts(part, seen)
    elif isinstance(value, (tuple, list)):
        for part in value:
            yield from _parts(part, seen)
    elif isinstance(value, (set, frozenset)):
        yield from sorted(repr(part) for part in value)
    elif isinstance(value, dict):
        for key, part in value.items():
            yield repr(key)
            yield from _parts(part, seen)
    elif isinstance(value, PLAIN):
        yield repr(value)
    else:
        yield f"{type(value).__module__}.{type(value).__qualname__}"


def _parts_of_code(code: CodeType, names: dict[str, Any], seen: set[int]) -> Iterator[str]:
    """Instructions and constants, and what the names in them stand for, where that is no library's."""
    yield code.co_code.hex()
    yield " ".join((*code.co_names, *code.co_varnames))
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _parts_of_code(constant, names, seen)
        else:
            yield from _parts(constant, seen)
    for name in code.co_names:
        value = names.get(name)
        if isinstance(value, ModuleType):
            if value.__name__.split(".")[0] != PACKAGE:
                continue
            for inner in code.co_names:
                yield from _parts(getattr(value, inner, None), seen)
        elif not isinstance(value, FunctionType) or not _is_of_library(value):
            yield from _parts(value, seen)


def _is_of_library(function: FunctionType) -> bool:
    """Whether a function's code follows from a version that is known: that of torch or of Python."""
    return function.__module__.split(".")[0] in ("torch", *sys.stdlib_module_names)
