"""Native code of coim: C++ files that are compiled on the machine that runs them, and kept for later processes.

The code lies where `torch.compile` keeps what it makes (``TORCHINDUCTOR_CACHE_DIR``), by a digest of all that it was
made from: its source, the compiler, what the processor can do. The files may be deleted at any time.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import torch

OPTIONS = ("-std=c++17", "-shared", "-fPIC")
FOR_THIS_PROCESSOR: tuple[list[str], ...] = (["-march=native"], ["-mcpu=native"], [])  # the first that a compiler knows


@dataclass(frozen=True, kw_only=True)
class Source:
    """A C++ file that becomes a library.

    Args:
        path: the file.
        headers: files beside it that it includes.
        options: of the compiler, beside those for this processor.
        wished: more of them, for compilers that know them.
        made_from: what else the code depends on, such as the version of what it includes.
        purpose: what the code is, in the plural, for errors.
        way_out: what who has no compiler can do, as a command.
    """

    path: Path
    headers: tuple[Path, ...] = ()
    options: tuple[str, ...]
    wished: tuple[str, ...] = ()
    made_from: str = ""
    purpose: str
    way_out: str

    def library(self) -> ctypes.CDLL:
        """Load the compiled code, of an earlier process or made now.

        Raises:
            RuntimeError: if there is no compiler, it cannot compile the source, or what it makes cannot be kept or
                loaded; the message has its words.
        """
        # What the compiler predefines names its version and what the processor can do: a home folder may serve others.
        command, predefined = self.command(find_compiler(self.way_out))
        texts = (file.read_text() for file in (self.path, *self.headers))
        parts = (*texts, predefined, repr(command), self.made_from)
        path = folder() / f"{self.path.stem}-{hashlib.sha256(chr(0).join(parts).encode()).hexdigest()}.so"
        if _is_whole(path):
            try:
                return ctypes.CDLL(str(path))
            except OSError:  # made with another C library, in a folder that several machines share
                pass
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=path.parent) as beside:
                made, seal = (Path(beside) / name for name in (path.name, _seal(path).name))
                self.run([*command, str(self.path), "-o", str(made)])
                seal.write_text(_digest(made))
                os.replace(made, path)
                os.replace(seal, _seal(path))
            return ctypes.CDLL(str(path))
        except OSError as error:
            raise RuntimeError(
                f"{self.purpose} cannot be kept in {path.parent}; name another folder by the environment variable "
                f"TORCHINDUCTOR_CACHE_DIR, or {self.way_out}: {error}"
            ) from error

    def command(self, compiler: str) -> tuple[list[str], str]:
        """Call of the compiler for this processor, and what it predefines then."""
        refused: RuntimeError | None = None
        for wished, more in product(dict.fromkeys([self.wished, ()]), FOR_THIS_PROCESSOR):
            command = [compiler, *OPTIONS, *self.options, *wished, *more]
            try:
                return command, self.run([*command, "-dM", "-E", "-x", "c++", os.devnull])
            except RuntimeError as error:
                refused = refused or error
        raise refused or RuntimeError

    def run(self, command: list[str]) -> str:
        """Run the compiler; return what it prints."""
        refused = f"{self.purpose} cannot be compiled, {self.way_out}"
        try:
            done = subprocess.run(command, capture_output=True, text=True, errors="replace")
        except OSError as error:  # a file that is no program
            raise RuntimeError(f"{refused}; {command[0]}: {error}") from error
        if done.returncode:
            said = done.stderr[-2000:] or f"it ended with {done.returncode}"
            raise RuntimeError(f"{refused}; {' '.join(command)}: {said}")
        return done.stdout


def _is_whole(path: Path) -> bool:
    """Whether a library is as it was made. Half a file can be loaded too, and then ends the process."""
    try:
        return _seal(path).read_text() == _digest(path)
    except (OSError, UnicodeDecodeError):
        return False


def _seal(path: Path) -> Path:
    """The file beside a library that has its digest."""
    return path.with_suffix(".sha256")


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def find_compiler(way_out: str) -> str:
    """Find the C++ compiler that `torch.compile` would take.

    Args:
        way_out: what who has none can do, as a command.

    Raises:
        RuntimeError: if there is none.
    """
    asked = os.environ.get("CXX")
    for name in [asked] if asked else ["g++", "clang++", "c++"]:
        if (found := shutil.which(name)) is not None:
            return found
    raise RuntimeError(f"no C++ compiler ({asked or 'g++, clang++ or c++'}) was found; install one, or {way_out}")


def folder() -> Path:
    """Where compiled code of coim lies: in the folder of what `torch.compile` makes."""
    from torch._inductor.runtime.cache_dir_utils import cache_dir

    return Path(cache_dir()) / __name__.split(".")[0]


@functools.cache
def team() -> int | None:
    """Address of ``GOMP_parallel``, by which code runs on the threads of torch's OpenMP; None if torch has another."""
    try:
        library = next((Path(torch.__file__).parent / "lib").glob("libtorch_cpu.*"))
        return ctypes.cast(ctypes.CDLL(str(library)).GOMP_parallel, ctypes.c_void_p).value
    except (StopIteration, OSError, AttributeError):
        return None
