"""A run's folder: the settings, and three CSV files that grow; new, or gone on with."""

from __future__ import annotations

import csv
import itertools
import json
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from coim.events import DesignChosen, DesignDone, EpisodeDone
from coim.experiments.frames import read_frame
from coim.experiments.run.atomic_write import shortest, telling_full_disk, write_whole
from coim.experiments.run.interrupt import cannot_write
from coim.experiments.run.provenance import describe
from coim.experiments.run.records import number
from coim.experiments.run.resume import note_resumption, refuse_filled
from coim.experiments.run.settings import Settings
from coim.run_folder import DESIGNS, EVALUATIONS, EXPECTED, METRICS, Row, design_rows, evaluation_rows, metric_rows
from coim.tables import Layout, entry_of_column, read_columns, read_table, same_columns


class Results:
    """Writes what happens in a run to its folder, row by row as it comes.

    Designs and episodes count from 1, runs from 0. The row of the episode in which a run diverged, and that of the
    design, say so in their last column; a run has no rows after them, so that no mean takes one that is frozen for one
    that learns.

    Args:
        folder: made if it does not exist.
        environment: name of the body, for ``config.json``.
        settings: of the run, for ``config.json``. With ``settings.resume`` the folder is gone on with: rows that came
            after the checkpoint are dropped, they will come again.
        design_names: of the D entries of a design.
        notes: the `notes` of the checkpoint that is gone on from; without them the files start anew.

    Raises:
        FileExistsError: if the folder of a new run already holds anything; nothing in it is touched.
        ValueError: if a CSV file has fewer rows than there were at the checkpoint, or one that cannot be read.
    """

    def __init__(
        self,
        folder: Path,
        environment: str,
        settings: Settings,
        design_names: Sequence[str],
        *,
        notes: Mapping[str, Any] | None = None,
    ) -> None:
        self.folder = folder
        # What was said of the design before it was built, by column of designs.csv.
        columns = ("predicted", *(EXPECTED if settings.chosen_by != "value" else ()))
        self._told: dict[str, list[float | None]] = {name: notes[name] if notes else [] for name in columns}
        self._seconds = self._seconds_before = notes["seconds"] if notes else 0.0
        rows = notes["rows"] if notes else {}
        if settings.resume is None:
            refuse_filled(folder)
            folder.mkdir(parents=True, exist_ok=True)
            write_whole(folder / "config.json", json.dumps(describe(environment, settings), indent=2) + "\n")
        else:
            note_resumption(folder, settings)
        self._design_names = design_names
        self._evaluations = self._table(EVALUATIONS, keep=rows.get("evaluations"))
        self._designs = self._table(DESIGNS, columns[1:], keep=rows.get("designs"))
        self._metrics: Table | None = None  # its columns are known when the first episode is done
        self._metrics_rows = rows.get("metrics", 0)

    def _table(self, layout: Layout, measured: Sequence[str] = (), *, keep: int | None) -> Table:
        """One of the files; the rows that it keeps are read at once, as they will be when the run is over."""
        path = self.folder / layout.file
        table = Table(path, layout.header(self._design_names, measured), keep=keep)
        if keep:
            read_table(path, layout)
        return table

    def write(self, event: DesignChosen | EpisodeDone | DesignDone, seconds: float) -> None:
        """Append the rows of one event; ``seconds`` is the wall-clock since this process took the run up."""
        seconds = self._seconds = self._seconds_before + seconds
        if isinstance(event, DesignChosen):
            for name in self._told:
                values = getattr(event, name)
                self._told[name] = [None] * len(event.design) if values is None else values.tolist()
        elif isinstance(event, EpisodeDone):
            self._evaluations.append(evaluation_rows(event, self._design_names, seconds))
            self._write_metrics(metric_rows(event))
        else:
            self._designs.append(design_rows(event, self._design_names, self._told))

    def _write_metrics(self, rows: Sequence[Row]) -> None:
        """Append what was measured while learning."""
        if self._metrics is None:
            measured = [name for name in rows[0] if name not in METRICS.columns]
            self._metrics = self._table(METRICS, measured, keep=self._metrics_rows or None)
        self._metrics.append(rows)
        self._metrics_rows = self._metrics.num_rows

    def notes(self) -> dict[str, Any]:
        """What a checkpoint must know to let the files grow on; plain JSON."""
        rows = {
            "evaluations": self._evaluations.num_rows,
            "designs": self._designs.num_rows,
            "metrics": self._metrics_rows,
        }
        return {"rows": rows, **{name: list(values) for name, values in self._told.items()}, "seconds": self._seconds}

    def table(self) -> str:
        """The designs and their best returns, for a terminal."""
        designs = read_frame(self._designs.path, DESIGNS)
        names = {name: entry_of_column(name) or name for name in designs.columns}
        designs = designs.rename(columns=names).replace("", "-")
        return designs.to_string(index=False, na_rep="-", float_format=number)


class Table:
    """A CSV file that grows; every append is on disk before the next line of the program.

    Args:
        path: of the file.
        columns: their names.
        keep: rows of an existing file that stay, and its header, in which the design's entries may have other names (in
            older folders they are counted); None begins a new one.

    Raises:
        ValueError: if the existing file has fewer rows, or other columns.
    """

    def __init__(self, path: Path, columns: Sequence[str], *, keep: int | None = None) -> None:
        self.path, self.columns, self.num_rows = path, columns, keep or 0
        if keep is None:
            write_whole(path, ",".join(columns) + "\n")
            return
        if not same_columns(read_columns(path), columns):
            raise ValueError(f"{path} has other columns than {columns}; go on with the version in config.json")
        lines = path.read_text(encoding="utf-8-sig").splitlines()  # unread: those that are dropped may be torn
        if len(lines) <= keep:
            raise ValueError(f"{path} has {len(lines) - 1} rows, the checkpoint was made after {keep}; put them back")
        write_whole(path, "\n".join(lines[: 1 + keep]) + "\n")

    def append(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Append rows, which have a cell for each column."""
        cells = [[_cell(row[name]) for name in self.columns] for row in rows]
        with telling_full_disk(self.path), self.path.open("a", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(cells)
            file.flush()
            os.fsync(file.fileno())
        self.num_rows += len(cells)


def _cell(value: Any) -> Any:
    """As a CSV file has it; a missing value is an empty cell."""
    return shortest(value) if isinstance(value, float) else "" if value is None else value


@contextmanager
def folder_of(environment: str, settings: Settings) -> Iterator[Path]:
    """The folder of a run: the one that is named, or a new one ``runs/ENVIRONMENT-DATE-NAME``.

    The new one is made at once, and has ``-2``, ``-3``, ... behind its name where another run was quicker. It is taken
    away again if the run cannot be put together.

    Raises:
        OSError: if it cannot be made.
    """
    if (named := settings.resume or settings.out) is not None:
        yield named
        return
    folder = new_folder(Path("runs") / f"{environment}-{time.strftime('%Y%m%d-%H%M%S')}-{settings.name}")
    try:
        yield folder
    except BaseException:
        folder.rmdir()
        raise


def new_folder(wanted: Path) -> Path:
    """Make a folder that nobody else has: the wanted one, or the next free name."""
    folder = wanted
    try:
        wanted.parent.mkdir(parents=True, exist_ok=True)
        for i in itertools.count(2):
            with suppress(FileExistsError):
                folder.mkdir()
                break
            folder = wanted.with_name(f"{wanted.name}-{i}")
    except OSError as error:
        raise cannot_write(folder, error) from error
    return folder
