"""Files that are either as they were or whole, whatever happens while they are written."""

from __future__ import annotations

import csv
import errno
import functools
import io
import itertools
import os
import stat
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

ASIDE = ".new-{}"  # a file's name until it is whole
FULL = {errno.ENOSPC, errno.EDQUOT}
READ_ONLY = {errno.EACCES, errno.EPERM, errno.EROFS}
NOT_OFFERED = {errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP}  # by a file system: a network's, a container's
PROBE = 1 << 16  # bytes


def shortest(value: float) -> str:
    """The fewest digits that give the same float32 again, so that a design read from a file is the body that was built.

    Example:
        >>> shortest(float(np.float32(0.8))), shortest(float(np.float32(4 / 3)))
        ('0.8', '1.3333334')
    """
    return str(np.float32(value)).removesuffix(".0")


def readable(text: str) -> str:
    r"""A text that can be written as UTF-8: bytes of a file's name that are not UTF-8 become the sign for that.

    Example:
        >>> readable(os.fsdecode(b"M\xe4nner"))
        'M\ufffdnner'
    """
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def as_csv(columns: Sequence[str], rows: Iterable[Mapping[str, object]]) -> str:
    """Rows as a CSV file has them."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def write_whole(path: Path, contents: str | bytes) -> None:
    """Write a file so that it has either its old contents or the new ones, whatever happens.

    Raises:
        OSError: if it cannot be written; of a full disk in a sentence.
    """
    with written_aside(path) as aside:
        aside.write_bytes(readable(contents).encode() if isinstance(contents, str) else contents)


@contextmanager
def written_aside(path: Path) -> Iterator[Path]:
    """Let a file be written under another name in the same folder, with the same suffix, and put it in its place.

    What is left of it after an error is deleted; see also `telling_full_disk`.
    """
    aside = path.with_name(ASIDE.format(path.name))
    try:
        with telling_full_disk(path):
            aside.touch()  # a folder that cannot be written to is an error of ours, and not many lines of a library
            yield aside
            sync(aside)
            os.replace(aside, path)
            sync(path.parent)
    finally:
        aside.unlink(missing_ok=True)


def dated_file(kind: str, suffix: str) -> Path:
    """Make an empty file ``runs/KIND-DATE`` that nobody else has, as `new_file` does."""
    return new_file(Path("runs") / f"{kind}-{time.strftime('%Y%m%d-%H%M%S')}{suffix}")


def new_file(wanted: Path) -> Path:
    """Make an empty file that nobody else has: the wanted one, with ``-2``, ``-3``, ... where there is one already.

    Raises:
        OSError: if it cannot be made.
    """
    with naming_out(wanted.parent):
        wanted.parent.mkdir(exist_ok=True)
        for i in itertools.count(1):
            path = wanted.with_stem(f"{wanted.stem}-{i}") if i > 1 else wanted
            with suppress(FileExistsError):
                path.touch(exist_ok=False)
                break
    return path


@contextmanager
def naming_out(place: Path) -> Iterator[None]:
    """Name the way out where a place of ours, such as a folder of a colleague's run, may not be written to.

    Raises:
        OSError: that names it; every other error stays what it is.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in READ_ONLY:
            raise
        raise OSError(f"{place} cannot be written to ({error.strerror}); name another place with --out") from error


@contextmanager
def telling_full_disk(path: Path) -> Iterator[None]:
    """Say of what fails while a file is written that the disk is full, where that is why.

    Libraries that write files raise errors of their own, which do not say it.

    Raises:
        OSError: that says so; every other error stays what it is.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        if not says_full(error) and not has_no_room(path.parent):
            raise
        raise OSError(f"disk full: {path} could not be written; make room on the disk of {path.parent}") from error


def says_full(error: Exception) -> bool:
    """Whether an error says that a disk is full, be it in the words of a compiler."""
    return getattr(error, "errno", None) in FULL or os.strerror(errno.ENOSPC) in str(error)


def has_no_room(folder: Path) -> bool:
    """Whether the disk of a folder is too full for a small file."""
    probe = folder / ASIDE.format(f"probe-{os.getpid()}")
    try:
        with probe.open("wb") as file:
            file.write(bytes(PROBE))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return error.errno in FULL
    finally:
        with suppress(OSError):
            probe.unlink(missing_ok=True)
    return False


def sync(path: Path) -> None:
    """Wait until a file's contents, or a folder's entries, are on the disk; not every file system does it for folders.

    Raises:
        OSError: if they are not.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in NOT_OFFERED | {errno.EINVAL} or not stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise
        warn_once(
            f"this file system does not write folders to the disk when it is asked to ({error.strerror}); the run goes "
            "on, but if the power goes its last files may be lost"
        )
    finally:
        os.close(descriptor)


@functools.cache
def warn_once(sentence: str) -> None:
    """Write a line to standard error, the first time."""
    print(f"warning: {sentence}", file=sys.stderr)
