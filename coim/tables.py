"""Read the CSV files of runs and studies; every cell is checked.

A file that a spreadsheet has saved again, or that somebody has edited, is read if it means the same, and refused by the
line that does not. Nothing is guessed, and no whole row is left out.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

DESIGN_PREFIX = "xi_"  # of the columns that hold a design
SHOWN = 60  # characters of what was found

Cell = str | int | float


@dataclass(frozen=True, kw_only=True)
class Layout:
    """A CSV file: its name, its columns and their types.

    Attributes:
        file: its name in the folder.
        columns: type of each column, in the order in which they are written. `DESIGN_PREFIX` stands for all columns of
            the design, which hold finite numbers. A number may be missing, as an empty cell. Columns that are not named
            here hold numbers.
        needed: columns without which it is another file: all whole numbers, and what older versions have written. Any
            other column that is missing is read as if its cells were empty.
        grows: whether rows are appended, so that the last line may be one that is still being written.
    """

    file: str
    columns: Mapping[str, type[str] | type[int] | type[float]]
    needed: tuple[str, ...]
    grows: bool = True

    def header(self, designs: Sequence[str] = (), measured: Sequence[str] = ()) -> list[str]:
        """Names of the columns of a new file.

        Args:
            designs: names of the entries of a design.
            measured: columns of numbers that the layout does not name; they come before ``diverged``, the last one.

        Example:
            >>> columns = {"run": int, "xi_": float, "diverged": str}
            >>> Layout(file="a.csv", columns=columns, needed=("run",)).header(["torso"], ["loss"])
            ['run', 'xi_torso', 'loss', 'diverged']
        """
        names: list[str] = []
        for name in self.columns:
            if name == "diverged":
                names += measured
            names += design_columns(designs) if name == DESIGN_PREFIX else [name]
        return names

    def type_of(self, column: str) -> type[str] | type[int] | type[float]:
        """Type of the cells of a column."""
        return self.columns.get(column, float)

    def value(self, column: str, cell: str) -> Cell:
        """The value of a cell; NaN for an empty cell of a number.

        Raises:
            ValueError: with what is expected, if it is something else.
        """
        kind = self.type_of(column)
        if kind is str:
            return cell
        if kind is int:
            return _number(int, cell, "a whole number")
        if column.startswith(DESIGN_PREFIX):
            if not math.isfinite(value := _number(float, cell, "a number")):
                raise ValueError("a finite number")
            return value
        return _number(float, cell, "a number or nothing") if cell else math.nan


def design_columns(names: Iterable[str]) -> list[str]:
    """Columns of a design in a CSV file; readers know them by their prefix, in older folders ``xi_1, xi_2, ...``.

    Example:
        >>> design_columns(["torso", "right thigh"])
        ['xi_torso', 'xi_right_thigh']
    """
    return [f"{DESIGN_PREFIX}{name.replace(' ', '_')}" for name in names]


def entry_of_column(column: str) -> str | None:
    """The name of an entry of the design from its column; None for other columns, and where older folders count.

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


def read_table(path: Path, layout: Layout) -> dict[str, list[Cell]]:
    """Read a CSV file.

    Args:
        path: of the file; one that does not exist is read as an empty one.
        layout: of the file.

    Returns:
        The cells of each column. Columns of the layout that the file does not have come last.

    Raises:
        ValueError: if it is not such a file in UTF-8, with commas between cells and points in numbers; with the line,
            what was found and what was expected.
    """
    columns = read_columns(path)
    if columns and not {*layout.needed} <= {*columns}:
        raise refusal(path, 1, ",".join(columns), f"columns {','.join(layout.needed)}")
    table: dict[str, list[Cell]] = {name: [] for name in columns}
    count = 0
    for line, cells in _rows(path, len(columns), grows=layout.grows):
        count += 1
        for column, cell in zip(columns, cells):
            try:
                table[column].append(layout.value(column, cell))
            except ValueError as error:
                raise refusal(path, line, f"{cell[:SHOWN]!r} in column {column}", str(error)) from None
    for name in layout.columns:
        if name not in (*columns, DESIGN_PREFIX):
            table[name] = [layout.value(name, "")] * count if count else []
    return table


def read_columns(path: Path) -> list[str]:
    """Names of the columns of a CSV file; none where it does not exist or is empty."""
    return next(csv.reader(_lines(path, grows=True)), [])


def _rows(path: Path, size: int, *, grows: bool) -> Iterator[tuple[int, list[str]]]:
    """Each row with the number of its line; pandas would fill short rows up and cut long ones without a word."""
    reader = csv.reader(_lines(path, grows=grows), strict=True)
    try:
        next(reader, None)
        for cells in reader:
            if len(cells) not in (0, size):  # spreadsheets end files with empty lines
                raise refusal(path, reader.line_num, f"{len(cells)} cells", f"{size} as in line 1")
            if cells:
                yield reader.line_num, cells
    except csv.Error as error:
        raise refusal(path, reader.line_num, str(error), f"{size} cells") from None


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
