"""Runs whose models were measured, joined where they are runs of one thing.

Shapes: R runs, X training steps.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from coim.experiments.statistics.intervals import mean, over_runs
from coim.run_folder import read_config

FOLDER = "model_error"  # of a study
LAST = 0.25  # share of the training steps that numbers in a caption are of
PLACES = ("seed", "num_runs", "name", "out", "resume", "wandb", "quiet", "threads", "checkpoint_every")
Row = dict[str, str]


class Kind(NamedTuple):
    """What runs have in common that are joined in one figure."""

    environment: str
    task: str
    designs: str


USUAL = ("forward", "known")  # task and designs that a figure's name leaves out


def folders_with(study: Path, file: str) -> dict[Kind, list[Path]]:
    """Folders of a study with a file of ``coim model-error``, by kind, in the order of their names."""
    found: dict[Kind, list[Path]] = {}
    for folder in sorted(path.parent for path in (study / FOLDER).rglob(file)):
        config = read_config(folder)
        settings = config["settings"]
        kind = Kind(config["environment"], settings.get("task", USUAL[0]), settings.get("imagine", USUAL[1]))
        found.setdefault(kind, []).append(folder)
    return dict(sorted(found.items()))


def name_of(stem: str, kind: Kind, kinds: Iterable[Kind]) -> str:
    """Of a figure: task and designs are part of it unless those of all kinds are the usual ones.

    Example:
        >>> name_of("figure", Kind("hopper", "forward", "known"), [Kind("hopper", "forward", "known")])
        'figure_hopper'
        >>> name_of("figure", kind := Kind("hopper", "backward", "known"), [kind])
        'figure_hopper_backward'
    """
    every = zip(*(other[1:] for other in kinds))
    parts = [part for part, values, usual in zip(kind[1:], every, USUAL) if {*values} != {usual}]
    return "_".join([stem, kind.environment, *parts])


def differences(folders: Sequence[Path]) -> list[str]:
    """Settings in which runs differ, besides the seed and what moves no number."""
    settings = [read_config(folder)["settings"] for folder in folders]
    names = sorted({name for one in settings for name in one} - {*PLACES})
    return [name for name in names if any(one.get(name) != settings[0].get(name) for one in settings)]


def with_shares(rows: Sequence[Row], folder: str, seed: int) -> list[dict[str, object]]:
    """Measurements of one folder with the share of the change that is not explained.

    Args:
        rows: of a run or a fleet.
        folder: as the rows shall call it.
        seed: of the run.

    Returns:
        The rows with ``folder`` and ``seed`` before them and ``share`` behind them: the error as a multiple of that of
        predicting no change on the same transitions, NaN where none counts or nothing changes.
    """
    still = {
        (row["run"], row["env_steps"], row["probe"]): float(row["normalised"])
        for row in rows
        if row["predict"] == "nothing"
    }
    found = []
    for row in rows:
        unit = still.get((row["run"], row["env_steps"], row["probe"]), np.nan)
        share = float(row["normalised"]) / unit if unit > 0 else np.nan
        found.append({"folder": folder, "seed": seed, **row, "share": share})
    return found


@dataclass(frozen=True)
class Curves:
    """One error over training.

    Attributes:
        steps: training steps of one run, ``[X]``, rising.
        runs: ``[R, X]``, NaN where a run was not measured or has no number.
    """

    steps: np.ndarray
    runs: np.ndarray

    @property
    def shared(self) -> np.ndarray:
        """Steps at which every run that has got so far has a number, ``[X]`` bool.

        Elsewhere a mean would be of other runs than beside it, and jump from one to the other.
        """
        known = np.isfinite(self.runs)
        beyond = np.flip(np.cumsum(np.flip(known, 1), 1), 1) == 0  # no number from here on: it is over, or under way
        return (known | beyond).all(0) & known.any(0)

    def mean(self) -> tuple[np.ndarray, ...]:
        """Steps that are shared, and there the mean over runs, the ends of its interval and the number of runs."""
        if not self.steps.size:
            return (self.steps,) * 5
        return self.steps[self.shared], *over_runs(self.runs[:, self.shared], mean)


def curves(rows: Sequence[dict[str, object]], probe: str, model: str, unit: str) -> Curves:
    """What was measured of a probe by a model in a unit, a line for each run of each folder."""
    runs: dict[tuple[object, object], dict[int, float]] = {}
    for row in rows:
        if (row["probe"], row["predict"]) == (probe, model):
            runs.setdefault((row["folder"], row["run"]), {})[int(str(row["env_steps"]))] = float(str(row[unit]))
    steps = sorted({step for run in runs.values() for step in run})
    values = [[run.get(step, np.nan) for step in steps] for run in runs.values()]
    return Curves(np.array(steps, dtype=int), np.array(values, dtype=float).reshape(len(runs), len(steps)))


def late_share(rows: Sequence[dict[str, object]], probe: str, model: str) -> tuple[float, float, float]:
    """Error over the last part of training as a share of the error of predicting no change.

    Of each run the sum of its errors over the sum of those of predicting no change, so that a measurement in which
    little moves counts little; then the mean over the runs that have one.

    Returns:
        The share, and the ends of its interval; NaN where there is no number.
    """
    errors, still = (curves(rows, probe, name, "normalised") for name in (model, "nothing"))
    late = errors.steps > first_late_step(rows)
    both = np.isfinite(errors.runs) & np.isfinite(still.runs) & late
    error, change = (np.where(both, found.runs, 0.0).sum(1, keepdims=True) for found in (errors, still))
    share = np.divide(error, change, out=np.full_like(error, np.nan), where=change > 0)
    if not np.isfinite(share).any():
        return np.nan, np.nan, np.nan
    value, low, high, _ = over_runs(share, mean)
    return float(value[0]), float(low[0]), float(high[0])


def first_late_step(rows: Sequence[dict[str, object]]) -> int:
    """Training steps after which the last part begins."""
    return round((1 - LAST) * max(int(str(row["env_steps"])) for row in rows))
