"""What the folders of runs hold, read back: also while a run is still writing to them.

Shapes: K runs, X points of a curve.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coim.envs import BODIES
from coim.experiments.run.atomic_write import readable
from coim.tables import DESIGN_PREFIX, OF_RUN, entry_of_column, read_columns, read_table

Row = dict[str, Any]


@dataclass(frozen=True)
class Record:
    """One run folder.

    Attributes:
        name: what the report calls it.
        config: ``config.json``.
        episodes: rows of ``evaluations.csv``, each with the cells that ``metrics.csv`` has for it.
        designs: a row per run and design, also of those under way: run, design, kind, xi, best_return, predicted,
            diverged, and whether it is finished, which it is not where the run diverged.
        design_names: of the entries of ``xi``, as the columns have them; where an older folder counts them, the body's.
    """

    name: str
    config: dict[str, Any]
    episodes: list[Row]
    designs: list[Row]
    design_names: tuple[str, ...]

    @property
    def environment(self) -> str:
        """Name of the body."""
        return self.config["environment"]

    @property
    def settings(self) -> dict[str, Any]:
        """Every setting of the run."""
        return self.config["settings"]

    @property
    def num_runs(self) -> int:
        """Runs that have a return."""
        return len({row["run"] for row in self.episodes if math.isfinite(row["return"])})

    @property
    def diverged(self) -> dict[int, Row]:
        """The last episode of each run that has diverged; its ``diverged`` says where."""
        return {row["run"]: row for row in self.episodes if row.get("diverged")}

    @property
    def best(self) -> dict[int, Row]:
        """The best design of each run that has one."""
        ranked = sorted((row for row in self.designs if math.isfinite(row["best_return"])), key=_best_return)
        return {row["run"]: row for row in ranked}


@dataclass(frozen=True)
class Curves:
    """Curves of K runs over the same points.

    Attributes:
        x: ``[X]``.
        y: ``[K, X]``, NaN where a run has no number.
    """

    x: np.ndarray
    y: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """Over the runs that have a number, ``[X]``."""
        known = np.isfinite(self.y)
        count = known.sum(0)
        total = np.where(known, self.y, 0.0).sum(0)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def averaged(self, block: int) -> Curves:
        """Means of so many neighbouring points each; the last has what is left."""
        starts = np.arange(0, self.x.size, block)
        if block == 1 or not starts.size:
            return self
        known = np.isfinite(self.y)
        count = np.add.reduceat(known.astype(int), starts, axis=1)
        total = np.add.reduceat(np.where(known, self.y, 0.0), starts, axis=1)
        width = np.diff(starts, append=self.x.size)
        y = np.where(count > 0, total / np.maximum(count, 1), np.nan)
        return Curves(np.add.reduceat(self.x, starts) / width, y)


def curves(rows: Sequence[Row], x: str, y: str) -> Curves:
    """One column over another, run by run; rows without the column are gaps."""
    runs = sorted({row["run"] for row in rows})
    points = sorted({row[x] for row in rows})
    values = np.full((len(runs), len(points)), np.nan)
    row_of, column_of = ({value: i for i, value in enumerate(found)} for found in (runs, points))
    for row in rows:
        values[row_of[row["run"]], column_of[row[x]]] = row.get(y, math.nan)
    values[~np.isfinite(values)] = np.nan
    known = np.isfinite(values).any(0)
    return Curves(np.array(points, dtype=float)[known], values[:, known])


def read_records(folders: Sequence[Path]) -> list[Record]:
    """Read run folders that are to be compared.

    Raises:
        ValueError: if one of them is no run, has no rows yet, or is of another environment than the first.
    """
    names = [readable(folder.resolve().name) for folder in folders]
    if len(set(names)) < len(names):
        names = [readable(str(folder)) for folder in folders]
    records = [read_record(folder, name) for folder, name in zip(folders, names)]
    environments = list(dict.fromkeys(record.environment for record in records))
    if len(environments) > 1:
        raise ValueError(f"the folders hold runs of {' and '.join(environments)}; compare runs of one environment")
    return records


def read_record(folder: Path, name: str) -> Record:
    """Read one run folder; see :func:`read_records`."""
    if not (folder / "config.json").is_file():
        raise ValueError(f"{folder} is no run folder: it has no config.json; name a folder that a recipe wrote")
    try:
        config = json.loads((folder / "config.json").read_text())
    except json.JSONDecodeError as error:
        raise ValueError(f"the config.json of {folder} cannot be read ({error})") from None
    if not isinstance(config, dict) or not {"environment", "settings"} <= config.keys():
        raise ValueError(f"{folder} is no run folder: its config.json names no environment and settings")
    episodes = read_rows(folder / "evaluations.csv")
    if not episodes:
        raise ValueError(f"{folder / 'evaluations.csv'} has no rows; wait for the first episode of the run")
    metrics = {_place(row): row for row in read_rows(folder / "metrics.csv")}
    episodes = [row | metrics.get(_place(row), {}) for row in episodes]
    designs = best_of_designs(episodes, read_rows(folder / "designs.csv"))
    return Record(name, config, episodes, designs, design_names(folder / "evaluations.csv", config["environment"]))


def read_rows(path: Path) -> list[Row]:
    """Rows of a CSV file of a run, the design as one tuple ``xi`` and NaN in empty cells.

    A last line that is still being written is left out, and a file that is not there has no rows.

    Raises:
        ValueError: if somebody has changed it so that it cannot be read; see `coim.tables.read_table`.
    """
    return [_with_design(row) for row in read_table(path, OF_RUN[path.name])]


def design_names(path: Path, environment: str) -> tuple[str, ...]:
    """Names of the entries of a design, from the columns of a table; the body's where they are counted there."""
    columns = [name for name in read_columns(path) if name.startswith(DESIGN_PREFIX)]
    body = BODIES.get(environment)
    if body is not None and len(columns) == body.DESIGN_SIZE:
        known = body.design_names()
    else:
        known = tuple(f"design {i}" for i in range(len(columns)))
    return tuple(entry_of_column(column) or name for column, name in zip(columns, known))


def _with_design(cells: Row) -> Row:
    """A row with its design as one tuple."""
    design = tuple(cell for column, cell in cells.items() if column.startswith(DESIGN_PREFIX))
    others = {column: cell for column, cell in cells.items() if not column.startswith(DESIGN_PREFIX)}
    return {"xi": design} | others if design else others


def best_of_designs(episodes: Sequence[Row], finished: Sequence[Row]) -> list[Row]:
    """A row per run and design from the episodes so far; Eq. 5 where ``designs.csv`` has the design already."""
    predicted = {(row["run"], row["design"]): row["predicted"] for row in finished}
    designs: dict[tuple[int, int], Row] = {}
    for row in episodes:
        key = (row["run"], row["design"])
        if key not in designs:
            known = {"predicted": predicted.get(key, math.nan), "best_return": row["return"]}
            designs[key] = {name: row[name] for name in ("run", "design", "kind", "xi")} | known
        diverged = row.get("diverged", "")
        found = designs[key] | {"diverged": diverged, "finished": key in predicted and not diverged}
        designs[key] = found | {"best_return": float(np.fmax(found["best_return"], row["return"]))}
    return list(designs.values())


def number(value: float, digits: int = 4) -> str:
    """A number for a reader: that many significant digits, thousands in full, a dash for what is not known."""
    if not math.isfinite(value):
        return "-"
    return f"{value:.0f}" if 10 ** (digits - 1) <= abs(value) < 1e7 else f"{value:.{digits}g}"


def _place(row: Row) -> tuple[int, int, int]:
    return row["run"], row["design"], row["episode"]


def _best_return(row: Row) -> float:
    return row["best_return"]
