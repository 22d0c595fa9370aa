"""Run folders read back, also while a run is still writing to them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from coim.envs import BODIES
from coim.experiments.frames import design_columns_of, read_frame
from coim.experiments.run.atomic_write import readable
from coim.run_folder import DESIGNS, EVALUATIONS, EXPECTED, METRICS, read_config
from coim.tables import entry_of_column

PLACE = ["run", "design", "episode"]


@dataclass(frozen=True)
class Record:
    """One run folder.

    Attributes:
        name: its name in the report.
        config: ``config.json``.
        episodes: rows of ``evaluations.csv``, each with the cells that ``metrics.csv`` has for it.
        designs: a row per run and design, also for those under way: run, design, kind, the columns of the design,
            best_return, predicted, expected and deviation (NaN where no posterior chose the bodies), diverged, and
            finished, which is False where the run diverged.
        design_names: names of the D entries of a design, as the columns have them; where an older folder counts them,
            the body's.
    """

    name: str
    config: dict[str, Any]
    episodes: pd.DataFrame
    designs: pd.DataFrame
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
        return self.episodes["run"][np.isfinite(self.episodes["return"])].nunique()

    @property
    def diverged(self) -> pd.DataFrame:
        """The last episode of each run that has diverged, by run; its ``diverged`` says where."""
        broken = self.episodes[self.episodes["diverged"] != ""]
        return broken.drop_duplicates("run", keep="last").set_index("run").sort_index()

    @property
    def best(self) -> pd.DataFrame:
        """The best design of each run that has one, by run."""
        known = self.designs[np.isfinite(self.designs["best_return"])]
        ranked = known.sort_values("best_return", kind="stable")
        return ranked.drop_duplicates("run", keep="last").set_index("run").sort_index()


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
    config = read_config(folder)
    episodes = read_frame(folder / EVALUATIONS.file, EVALUATIONS)
    if episodes.empty:
        raise ValueError(f"{folder / EVALUATIONS.file} has no rows; wait for the first episode of the run")
    metrics = read_frame(folder / METRICS.file, METRICS).drop_duplicates(PLACE, keep="last")
    measured = [column for column in metrics if column in PLACE or column not in episodes]
    episodes = episodes.merge(metrics[measured], how="left", on=PLACE)
    designs = best_of_designs(episodes, read_frame(folder / DESIGNS.file, DESIGNS))
    return Record(name, config, episodes, designs, design_names(episodes, config["environment"]))


def design_names(rows: pd.DataFrame, environment: str) -> tuple[str, ...]:
    """Names of the entries of a design, from the columns of a table; the body's where they are counted there."""
    columns = design_columns_of(rows)
    body = BODIES.get(environment)
    if body is not None and len(columns) == body.DESIGN_SIZE:
        known = body.design_names()
    else:
        known = tuple(f"design {i}" for i in range(len(columns)))
    return tuple(entry_of_column(column) or name for column, name in zip(columns, known))


def best_of_designs(episodes: pd.DataFrame, finished: pd.DataFrame) -> pd.DataFrame:
    """The best return on each design of each run so far, in the order in which they were tried.

    Args:
        episodes: rows of ``evaluations.csv``.
        finished: rows of ``designs.csv``, which has the designs whose episodes are all over, with Eq. 5.

    Returns:
        A row per run and design; see `Record`.
    """
    first = dict.fromkeys(["kind", *design_columns_of(episodes)], "first")
    designs = episodes.groupby(["run", "design"], sort=False, as_index=False).agg(
        first | {"return": "max", "diverged": "last"}
    )
    told = finished.reindex(columns=["run", "design", "predicted", *EXPECTED])
    told = told.drop_duplicates(["run", "design"], keep="last")
    designs = designs.merge(told, how="left", on=["run", "design"], indicator="finished")
    designs["finished"] = (designs["finished"] == "both") & (designs["diverged"] == "")
    return designs.rename(columns={"return": "best_return"})


def number(value: float, digits: int = 4) -> str:
    """A number for a reader: that many significant digits, thousands in full, a dash for what is not known."""
    if not math.isfinite(value):
        return "-"
    return f"{value:.0f}" if 10 ** (digits - 1) <= abs(value) < 1e7 else f"{value:.{digits}g}"
