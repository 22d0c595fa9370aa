"""Rows at the end of a CSV file: what a long comparison writes when a run is over."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

from coim.experiments.run.atomic_write import telling_full_disk


def append_rows(path: Path, rows: Iterable[Sequence[object]]) -> None:
    """Append rows to a file, which is made if there is none.

    Raises:
        OSError: if it cannot be written; of a full disk in a sentence.
    """
    with telling_full_disk(path), path.open("a", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)
