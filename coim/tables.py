"""The CSV files of runs and studies, read back; every cell is checked.

A file that a spreadsheet has saved again, or that somebody has edited, is read if it means the same, and refused by the
line that does not. Nothing is guessed, and no row that is whole is left out.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

DESIGN_PREFIX = "xi_"  # of the columns that hold a design
SHOWN = 60  # characters of what was found

Cell = str | int | float


@dataclass(frozen=True, kw_only=True)
class Layout:
    """What the columns of a CSV file hold: numbers or nothing, but for those that are named here and the design's.

    Attributes:
        needed: columns without which it is another file.
        words: columns of text.
        counts: columns of whole numbers.
        grows: whether rows are appended, so that the last line may be one that is still being written.
    """

    needed: tuple[str, ...]
    words: tuple[str, ...] = ()
    counts: tuple[str, ...] = ()
    grows: bool = True

    def value(self, column: str, cell: str) -> Cell:
        """What a cell holds; NaN for an empty one that may be empty.

        Raises:
            ValueError: with what is expected, if it is something else.
        """
        if column in self.words:
            return cell
        if column in self.counts:
            return _number(int, cell, "a whole number")
        if column.startswith(DESIGN_PREFIX):
            if not math.isfinite(value := _number(float, cell, "a number")):
                raise ValueError("a finite number")
            return value
        return _number(float, cell, "a number or nothing") if cell else math.nan


WORDS, COUNTS = ("kind", "diverged"), ("run", "design", "episode", "env_steps")
OF_RUN = {  # files of a run's folder
    "evaluations.csv": Layout(needed=("run", "design", "kind", "episode", "return"), words=WORDS, counts=COUNTS),
    "designs.csv": Layout(needed=("run", "design", "kind", "predicted", "best_return"), words=WORDS, counts=COUNTS),
    "metrics.csv": Layout(needed=("run", "design", "episode"), words=WORDS, counts=COUNTS),
}


def design_columns(names: Sequence[str]) -> list[str]:
    """Columns of a design in a CSV file; readers know them by how they begin, in older folders by ``xi_1, xi_2, ...``.

    Example:
        >>> design_columns(["torso", "right thigh"])
        ['xi_torso', 'xi_right_thigh']
    """
    return [f"{DESIGN_PREFIX}{name.replace(' ', '_')}" for name in names]


def entry_of_column(column: str) -> str | None:
    """The name of an entry of the design from its column; None of other columns, and where older folders count.

    Example:
        >>> entry_of_column("xi_right_thigh"), entry_of_column("xi_2"), entry_of_column("run")
        ('right thigh', None, None)
    """
    entry = column.removeprefix(DESIGN_PREFIX)
    return None if entry == column or entry.isdigit() else entry.replace("_", " ")


def same_columns(found: Sequence[str], wanted: Sequence[str]) -> bool:
    """Whether two headers hold the same, whatever the entries of the design are called."""
    return len(found) == len(wanted) and all(
        one == other or (one.startswith(DESIGN_PREFIX) and other.startswith(DESIGN_PREFIX))
        for one, other in zip(found, wanted)
    )


def read_table(path: Path, layout: Layout) -> list[dict[str, Cell]]:
    """Rows of a CSV file, numbers as numbers.

    Args:
        path: of the file; one that is not there has no rows.
        layout: of its columns.

    Raises:
        ValueError: if it is not such a file in UTF-8, with commas between cells and points in numbers; with the line,
            what was found and what was expected.
    """
    return [{column: value for column, (_, value) in row.items()} for row in _rows(path, layout)]


def read_cells(path: Path, layout: Layout) -> list[dict[str, str]]:
    """Rows of a CSV file as they are written, each cell of which is what it must be; see `read_table`."""
    return [{column: cell for column, (cell, _) in row.items()} for row in _rows(path, layout)]


def read_columns(path: Path) -> list[str]:
    """Names of the columns of a CSV file; none where it is not there or empty."""
    return next(csv.reader(_lines(path, grows=True)), [])


def _rows(path: Path, layout: Layout) -> Iterator[dict[str, tuple[str, Cell]]]:
    """Each row, with each cell as it is written and what it holds."""
    reader = csv.reader(_lines(path, grows=layout.grows), strict=True)
    try:
        columns = next(reader, None)
        if columns is None:
            return
        if not {*layout.needed} <= {*columns}:
            raise refusal(path, 1, ",".join(columns), f"columns {','.join(layout.needed)}")
        for cells in reader:
            if cells:  # spreadsheets end files with empty lines
                yield _row(path, reader.line_num, columns, cells, layout)
    except csv.Error as error:
        raise refusal(path, reader.line_num, str(error), f"{len(columns or ())} cells") from None


def _row(path: Path, line: int, columns: list[str], cells: list[str], layout: Layout) -> dict[str, tuple[str, Cell]]:
    if len(cells) != len(columns):
        raise refusal(path, line, f"{len(cells)} cells", f"{len(columns)} as in line 1")
    row = {}
    for column, cell in zip(columns, cells):
        try:
            row[column] = cell, layout.value(column, cell)
        except ValueError as error:
            raise refusal(path, line, f"{cell[:SHOWN]!r} in column {column}", str(error)) from None
    return row


def _lines(path: Path, *, grows: bool) -> list[str]:
    """Lines of a file with their ends; without a last one that has none yet, if the file grows."""
    if not path.is_file():
        return []
    contents = path.read_bytes()
    try:
        lines = list(io.StringIO(contents.decode("utf-8-sig"), newline=""))
    except UnicodeDecodeError as error:
        line = contents.count(b"\n", 0, error.start) + 1
        raise refusal(path, line, f"the byte 0x{contents[error.start]:02x}", "text in UTF-8") from None
    if grows and lines and not lines[-1].endswith(("\n", "\r")):
        lines.pop()
    return lines


def _number(kind: type[int] | type[float], cell: str, expected: str) -> int | float:
    try:
        return kind(cell)
    except ValueError:
        raise ValueError(expected) from None


def refusal(path: Path, line: int, found: str, expected: str) -> ValueError:
    """The sentence about a file that cannot be read."""
    found = found if len(found) <= SHOWN + 40 else found[:SHOWN] + "..."
    return ValueError(
        f"{path}, line {line}: found {found}, expected {expected}; put the file back from a copy, or save it again in "
        "UTF-8 with commas between cells and points in numbers"
    )
