"""How far a study has got: one row for each cell, in a file that is always whole."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from coim.experiments.frames import read_frame
from coim.experiments.run.atomic_write import as_csv, write_whole
from coim.experiments.study.definition import Cell
from coim.tables import Layout

State = Literal["waiting", "running", "finished", "failed"]


@dataclasses.dataclass
class Entry:
    """One cell.

    Attributes:
        cell: its name, and that of its folder.
        state: waiting has not begun, or was stopped and goes on from its checkpoint.
        tries: how often somebody began to compute it, or went on.
        seconds: of computing, for a finished cell.
        message: why it failed.
    """

    cell: str
    environment: str
    task: str
    arm: str
    seed: int
    state: State = "waiting"
    tries: int = 0
    seconds: float | None = None
    message: str = ""


LAYOUT = Layout(
    file="ledger.csv",
    columns={
        "cell": str,
        "environment": str,
        "task": str,
        "arm": str,
        "seed": int,
        "state": str,
        "tries": int,
        "seconds": float,
        "message": str,
    },
    needed=tuple(field.name for field in dataclasses.fields(Entry)),
    grows=False,
)


class Ledger:
    """The rows of ``ledger.csv``; every change is on disk before the next line of the program.

    Args:
        path: of the file. If it exists, what is finished stays so, and all else waits again; nothing is written yet.
        cells: of the study, in the order in which they are computed.

    Raises:
        ValueError: if the file is damaged, or knows of a cell that has begun and that the study does not have.
    """

    def __init__(self, path: Path, cells: Iterable[Cell]) -> None:
        self.path = path
        self.entries = {
            cell.name: Entry(cell.name, cell.environment, cell.settings.task, cell.arm, cell.settings.seed)
            for cell in cells
        }
        for row in read_ledger(path):
            if row.cell not in self.entries:
                if row.tries == 0:
                    continue  # of a larger study that never came to it
                raise ValueError(
                    f"{path} has the cell {row.cell}, which this study has not; name another folder with --out"
                )
            state: State = "finished" if row.state == "finished" else "waiting"
            self.entries[row.cell] = dataclasses.replace(row, state=state)

    def note(self, cell: str, state: State, **values: int | float | str | None) -> None:
        """Change a row."""
        self.entries[cell] = dataclasses.replace(self.entries[cell], state=state, **values)  # type: ignore[arg-type]
        self.write()

    def stop(self) -> None:
        """Nobody computes anything any more."""
        for name, entry in self.entries.items():
            if entry.state == "running":
                self.entries[name] = dataclasses.replace(entry, state="waiting")
        self.write()

    def write(self) -> None:
        """Put the file in the place of the old one."""
        write_whole(self.path, in_csv(self.entries.values()))

    def in_state(self, *states: State) -> list[str]:
        """Names of the cells in these states."""
        return [name for name, entry in self.entries.items() if entry.state in states]


def in_csv(entries: Iterable[Entry]) -> str:
    """What stands in a ``ledger.csv``."""
    return as_csv(LAYOUT.header(), map(vars, entries))


def read_ledger(path: Path) -> list[Entry]:
    """The rows of a ``ledger.csv``; none where there is no such file.

    Raises:
        ValueError: if it cannot be read as one.
    """
    try:
        rows = read_frame(path, LAYOUT)
    except ValueError as error:
        raise ValueError(f"{error}; or delete it, and what is finished is found again by its checkpoints") from None
    rows["seconds"] = rows["seconds"].astype("object").where(rows["seconds"].notna(), None)
    return [Entry(*cells) for cells in rows[LAYOUT.header()].itertuples(index=False, name=None)]
