"""Files that are either as they were or whole, whatever happens while they are written."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

ASIDE = ".{}.new"  # a file's name until it is whole


def shortest(value: float) -> str:
    """The fewest digits that give the same float32 again, so that a design read from a file is the body that was built.

    Example:
        >>> shortest(float(np.float32(0.8))), shortest(float(np.float32(4 / 3)))
        ('0.8', '1.3333334')
    """
    return str(np.float32(value)).removesuffix(".0")


def write_whole(path: Path, contents: str | bytes) -> None:
    """Write a file so that it has either its old contents or the new ones, whatever happens."""
    aside = path.with_name(ASIDE.format(path.name))
    with aside.open("wb") as file:
        file.write(contents.encode() if isinstance(contents, str) else contents)
        file.flush()
        os.fsync(file.fileno())
    os.replace(aside, path)
    sync(path.parent)


def sync(path: Path) -> None:
    """Wait until a file's contents, or a folder's entries, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
