"""Ctrl-C, SIGTERM, two processes on one folder, and a folder that cannot be written to."""

from __future__ import annotations

import errno
import io
import os
import platform
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import IO

from coim.experiments.run.atomic_write import FULL, NOT_OFFERED, READ_ONLY, telling_full_disk, warn_once

try:
    import fcntl
except ImportError:  # not a Unix
    fcntl = None  # type: ignore[assignment]

LOCK = ".lock"
PATIENCE = 3  # s
ANY_NAME = "backslashreplace"  # folders may have names that cannot be printed; standard error has always been so


class Stopped(KeyboardInterrupt):
    """This process was told to end.

    Attributes:
        signum: 2 is Ctrl-C, 15 is what schedulers send.
    """

    def __init__(self, signum: int) -> None:
        super().__init__()
        self.signum = signum

    def __str__(self) -> str:
        return "stopped by " + ("Ctrl-C" if self.signum == signal.SIGINT else signal.Signals(self.signum).name)


@contextmanager
def stopping_at_once() -> Iterator[None]:
    """Raise `Stopped` at the first Ctrl-C or SIGTERM, wherever the program is; a second one ends the process.

    Nothing is saved on the way out: there is a checkpoint of every episode, and the rest of this one can take long.
    In a thread beside the main one, which no signal reaches, nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    told: list[int] = []

    def stop(signum: int, frame: FrameType | None) -> None:
        told.append(signum)
        for name in before:
            signal.signal(name, end)
        raise Stopped(signum)

    def end(signum: int, frame: FrameType | None) -> None:
        os._exit(128 + signum)

    before = {signum: signal.signal(signum, stop) for signum in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    except (Exception, KeyboardInterrupt) as error:
        if told and not isinstance(error, Stopped):  # compiled code and Ray raise an error of their own instead
            raise Stopped(told[0]) from error
        raise
    finally:
        stopped = signal.getsignal(signal.SIGINT) is end
        for signum, handler in before.items():
            # A process that was told to end must end at once at a second Ctrl-C.
            signal.signal(signum, end if stopped else handler)


@contextmanager
def on_command_line(*, own_process: bool, also: tuple[type[Exception], ...] = (), again: str = "") -> Iterator[None]:
    """End a command with one line where its input is wrong or it was told to end.

    Args:
        own_process: whether the process ends with what is done here.
        also: errors that are told in one line, beside those of a value or of the system.
        again: the way to go on after it was told to end.

    Raises:
        SystemExit: 128 + 2 after Ctrl-C, 128 + 15 after SIGTERM, or the line of an error.
    """
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors=ANY_NAME)
    expected: tuple[type[Exception], ...] = (ValueError, OSError, *also)
    try:
        with stopping_at_once():
            yield
    except Stopped as stop:
        print(f"\n{stop}{again and '; '}{again}", file=sys.stderr)
        if own_process:
            end_soon(stop.signum)
        sys.exit(128 + stop.signum)
    except expected as error:
        sys.exit(sentence_of(error))
    except SystemExit as leaving:
        if own_process and isinstance(leaving.__context__, Stopped):
            end_soon(leaving.__context__.signum)
        raise


def sentence_of(error: BaseException) -> str:
    """An error as a sentence, which does not begin with the name of an exception or a number of the system.

    Example:
        >>> sentence_of(ValueError("num_designs is 0, it must be at least 1"))
        'num_designs is 0, it must be at least 1'
        >>> sentence_of(FileNotFoundError(2, "No such file or directory", "runs/a"))
        'runs/a: No such file or directory'
        >>> sentence_of(KeyError("seed"))
        "'seed' (KeyError)"
        >>> sentence_of(ModuleNotFoundError("No module named 'imageio'", name="imageio"))
        "No module named 'imageio': pip install 'coim[experiments]' has all that this command needs"
    """
    if isinstance(error, ModuleNotFoundError) and error.name and error.name.split(".")[0] != "coim":
        return f"{error}: pip install 'coim[experiments]' has all that this command needs"
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if str(error) and not isinstance(error, KeyError):
        return str(error)
    return f"{error} ({type(error).__name__})".strip()  # the text of a KeyError is its key


def end_soon(signum: int) -> None:
    """Let this process end by itself, but not later than in a few seconds, with the code of a signal.

    The interpreter waits for threads that are not over: one that compiles takes half a minute. For a process whose
    main thread is about to leave, and for no other.
    """
    timer = threading.Timer(PATIENCE, os._exit, [128 + signum])
    timer.daemon = True
    timer.start()


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep every other process out of a run's folder, which is made if it does not exist.

    The system drops the lock when the process ends, however it ends.

    Raises:
        BlockingIOError: if another process is at work in it.
        OSError: if it cannot be made or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / LOCK).open("a+")
    except OSError as error:
        raise cannot_write(folder, error) from error
    with lock as file:
        try:
            take_lock(file)
        except BlockingIOError:
            file.seek(0)
            owner = file.read().strip() or "another process"
            raise BlockingIOError(f"{folder} is in use by {owner}; wait for it, or stop it") from None
        except OSError as error:
            if error.errno not in NOT_OFFERED | {errno.ENOLCK}:
                raise
            warn_once(
                f"{folder} cannot be locked, its file system has no locks ({error.strerror}); the run goes on, but let "
                "no second process write to it"
            )
        with telling_full_disk(folder / LOCK):
            file.truncate(0)
            os.write(file.fileno(), f"process {os.getpid()} on {platform.node()}".encode())
        yield


def take_lock(file: IO[str]) -> None:
    """Lock a file until it is closed.

    Raises:
        BlockingIOError: if another process has it.
        OSError: if there are no locks here.
    """
    if fcntl is None:
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def cannot_write(folder: Path, error: OSError) -> OSError:
    """The error for a run's folder that cannot be made or written to."""
    if error.errno in FULL:
        return OSError(f"disk full: {folder} cannot be written to; make room there, or name another one with --out")
    first = "make it writable, or " if error.errno in READ_ONLY else ""
    return OSError(
        f"{folder} cannot be written to ({error.strerror}); {first}name another folder for a new run with --out"
    )


def says_read_only(error: BaseException | None) -> bool:
    """Whether an error, or what it came from, is that a folder may not be written to."""
    while error is not None and getattr(error, "errno", None) not in READ_ONLY:
        error = error.__cause__
    return error is not None
