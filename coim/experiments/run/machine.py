"""The machine of a run: threads, memory, device, products."""

from __future__ import annotations

import importlib.util
import logging
import os
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import torch

from coim.envs import native_episode
from coim.experiments.run.atomic_write import says_full
from coim.native import find_compiler
from coim.objectives import native_gradients
from coim.products import Choice, Library, Named, use

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of malloc.h
KEPT = 1 << 30  # bytes


def available_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def checked_device(name: str) -> torch.device:
    """The device, or a sentence that says why it cannot be used."""
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"device {name!r} cannot be used here ({reason}); try --device cpu") from None
    return device


def check_compiler(without: str = "--no-compile --no-native-episodes", *, makes: bool = True) -> None:
    """Refuse to compile where it cannot work, before anything is written.

    Args:
        without: options that do without, for the message.
        makes: whether something will be made for certain, in place of taking what an earlier process has made.

    Raises:
        ValueError: if there is no C++ compiler, or what it makes could not be put there or not be loaded from there.
    """
    try:
        find_compiler(without)
    except RuntimeError as error:
        raise ValueError(str(error)) from None
    folder = folder_of_compiled_code()
    there = next(path for path in (folder, *folder.parents) if path.exists())
    noexec = hasattr(os, "ST_NOEXEC") and os.statvfs(there).f_flag & os.ST_NOEXEC
    if noexec or (makes and not os.access(there, os.W_OK)):
        why = "is mounted noexec" if noexec else "cannot be written to"
        raise ValueError(
            f"compiled code is put into {folder} and loaded from there, which {why}; name another folder by the "
            f"environment variable TORCHINDUCTOR_CACHE_DIR, or {without}"
        )


def check_logger(kind: str) -> None:
    """Refuse to log by a package that is not installed, before anything is written.

    Args:
        kind: the setting ``log``.

    Raises:
        ValueError: with the way to install it.
    """
    package = kind.removesuffix("-offline")
    if kind != "off" and importlib.util.find_spec(package) is None:
        raise ValueError(f"--log {kind} needs {package}, which is not installed: pip install {package}, or --log off")


def check_native_code(*, gradients: bool, episodes: bool) -> None:
    """Compile the native code that a run will need, or find what an earlier process has compiled.

    Args:
        gradients: whether it needs native gradients.
        episodes: whether it needs native episodes.

    Raises:
        ValueError: if it cannot be compiled; the message has the compiler's words.
        OSError: if the disk is full.
    """
    for needed, library, without in (
        (gradients, native_gradients.library, "--no-compile"),
        (episodes, native_episode.library, "--no-native-episodes"),
    ):
        try:
            if needed:
                library()
        except RuntimeError as error:
            if says_full(error):
                raise OSError(f"disk full: {error}; make room there, or {without}") from error
            raise ValueError(f"{error} ({without})") from error


def folder_of_compiled_code() -> Path:
    """Where compiled code lies, or the folder in which torch makes one for it."""
    return Path(os.environ.get("TORCHINDUCTOR_CACHE_DIR") or tempfile.gettempdir()).absolute()


def prepare(threads: int, device: torch.device) -> bool:
    """Set this process up for training.

    Every learner gets one thread: two learners side by side take 0.63 of the time that they take one after the other
    (docs/results), and threads that wait for each other inside of products collapse when a second process wants the
    same cores, while threads that do not wait only share them.

    Args:
        threads: threads that may be busy at once.
        device: device of the networks.

    Returns:
        Whether to train the learners side by side.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it reports every storage that it allocates
    torch.set_num_threads(1)
    keep_freed_memory()
    return threads > 1 and device.type == "cpu"


def choose_products(wanted: Named, *, begun: Mapping[str, Library] | None = None, changed: bool = False) -> Choice:
    """Choose the library of all products on the CPU, and say where a run that goes on may round otherwise from here.

    Args:
        wanted: the setting.
        begun: what was chosen so far for the run that goes on; it is kept unless the setting was changed, or this
            machine cannot take it.
        changed: whether the setting is another one than before.

    Raises:
        ValueError: if this machine has not the library that was named.
    """
    here = use(wanted)
    if begun is None or (kept := Choice(**begun)) == here:
        return here
    why = ""
    if not changed:
        try:
            use(kept)
        except ValueError as error:
            why = f" ({error})"
        else:
            told = f"products stay by {words_of(kept)}, as the run began; a new one would take {words_of(here)} here"
            print(f"warning: {told}; the numbers may differ from here", file=sys.stderr)
            return kept
    told = f"products were by {words_of(kept)} and are by {words_of(here)}{why}"
    print(f"warning: {told}; the numbers may differ from here", file=sys.stderr)
    return here


def words_of(products: Choice) -> str:
    """A choice in a few words: ``torch``, or ``torch, bfloat16 emulated``."""
    if products.bfloat16 == products.float32:
        return products.float32
    bfloat16 = "emulated" if products.bfloat16 == "emulated" else f"by {products.bfloat16}"
    return f"{products.float32}, bfloat16 {bfloat16}"


def keep_freed_memory() -> None:
    """Keep the allocator from giving activations back to the system after every product (glibc; elsewhere nothing).

    By default it maps and unmaps each block above 128 KB, and the page faults cost a third of an update.
    """
    try:
        import ctypes

        mallopt = ctypes.CDLL(None).mallopt
    except (ImportError, OSError, AttributeError, TypeError):
        return
    mallopt(M_MMAP_THRESHOLD, KEPT)
    mallopt(M_TRIM_THRESHOLD, KEPT)
