"""Replay_Pop on disk: one file that only grows.

Shapes: T rows, K runs.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from coim.experiments.run.atomic_write import telling_full_disk


class ReplayFile:
    """Rows in the order in which they came, each a fixed number of bytes, one entry after the other.

    A checkpoint says how many bytes were its own and what their SHA-256 is. What was written after it, by a process
    that was killed before its next checkpoint, is cut off when the checkpoint is read.

    Args:
        path: of the file; made with the first rows.

    Attributes:
        num_rows: rows that are in it.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.num_rows = path, 0
        self._size, self._digest = 0, hashlib.sha256()
        self._layout: list[list[Any]] = []

    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Write rows ``[T, K, ...]`` behind the others, and be sure that they are on the disk."""
        count = len(next(iter(rows.values()), ()))
        if not count:
            return
        columns = {key: np.ascontiguousarray(rows[key].detach().cpu().numpy()) for key in sorted(rows)}
        self._layout = [[key, column.dtype.str, list(column.shape[1:])] for key, column in columns.items()]
        table = np.concatenate([column.reshape(count, -1).view(np.uint8) for column in columns.values()], 1)
        with telling_full_disk(self.path), self.path.open("r+b" if self.path.exists() else "wb") as file:
            file.truncate(self._size)  # an append that failed may have left a part of itself
            file.seek(self._size)
            file.write(table.data)
            file.flush()
            os.fsync(file.fileno())
        self._digest.update(table.data)
        self._size, self.num_rows = self._size + table.nbytes, self.num_rows + count

    def description(self) -> dict[str, Any]:
        """What a checkpoint must know to find these very rows again; plain JSON."""
        return {
            "rows": self.num_rows,
            "bytes": self._size,
            "sha256": self._digest.hexdigest(),
            "layout": self._layout,
        }

    def complaint(self, description: Mapping[str, Any]) -> str | None:
        """What is wrong with the described part of the file, or None."""
        size = self.path.stat().st_size if self.path.exists() else 0
        if size < description["bytes"]:
            return f"{self.path.name} has {size} of its {description['bytes']} bytes"
        if hashlib.sha256(self._bytes(description).data).hexdigest() != description["sha256"]:
            return f"the first {description['bytes']} bytes of {self.path.name} are not those that were written"
        return None

    def read(self, description: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return the described rows and go on behind them; later ones are cut off."""
        self.num_rows, self._size, self._layout = (description[key] for key in ("rows", "bytes", "layout"))
        self._digest = hashlib.sha256(self._bytes(description).data)
        rows = self.peek(description)
        if self.path.exists():
            os.truncate(self.path, self._size)
        return rows

    def peek(self, description: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return the described rows ``[T, K, ...]``; the file is not changed, and a run may go on to write it."""
        table, count = self._bytes(description), description["rows"]
        rows, start = {}, 0
        for key, dtype, shape in description["layout"]:
            stop = start + np.dtype(dtype).itemsize * int(np.prod(shape))
            column = np.ascontiguousarray(table.reshape(count, -1)[:, start:stop])
            rows[key] = torch.from_numpy(column.view(dtype).reshape(count, *shape))
            start = stop
        return rows

    def _bytes(self, description: Mapping[str, Any]) -> np.ndarray:
        """The described part of the file, mapped rather than read: it may be as large as the replay."""
        if not description["bytes"]:
            return np.empty(0, np.uint8)
        return np.memmap(self.path, np.uint8, mode="r", shape=(description["bytes"],))
