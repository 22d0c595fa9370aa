"""Join the measurements of runs that share a configuration."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from coim.experiments.frames import Curves, curves
from coim.experiments.statistics.intervals import mean, over_runs
from coim.run_folder import read_config
from coim.tables import DESIGN_PREFIX, Layout

FOLDER = "model_error"  # of a study
ERRORS = Layout(  # in the folder of a run whose models are measured
    file="model_error.csv",
    columns={
        "run": int,
        "design": int,
        "episode": int,
        "env_steps": int,
        "probe": str,
        "predict": str,
        "mse": float,
        "normalised": float,
        "rows": int,
        "impossible": float,
    },
    needed=("run", "design", "episode", "env_steps", "probe", "predict", "mse", "normalised", "rows", "impossible"),
)
CHANGES = Layout(  # beside it; and two columns of the change by each model and by the simulator
    file="design_space.csv",
    columns={
        "state": int,
        "point": str,
        "pc_1": float,
        "pc_2": float,
        DESIGN_PREFIX: float,
        "depth": float,
        "share_1": float,
        "share_2": float,
    },
    needed=("state", "point", "pc_1", "pc_2", "depth"),
    grows=False,
)
LAST = 0.25  # share of the training steps that numbers in a caption are of
PLACES = ("seed", "num_runs", "name", "out", "resume", "log", "wandb", "quiet", "threads", "checkpoint_every")
MEASUREMENT = ["run", "env_steps", "probe"]  # columns that name one measurement of several models in a folder


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
    """Name of a figure: task and designs are part of it unless those of all kinds are the usual ones.

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


def with_shares(rows: pd.DataFrame, folder: str, seed: int) -> pd.DataFrame:
    """Add to the measurements of one folder the share of the change that is not explained.

    Args:
        rows: of ``model_error.csv``, of one run or of several.
        folder: name of the folder in the result.
        seed: of the folder's settings.

    Returns:
        The rows with ``folder`` and ``seed`` before them and ``share`` behind them: the error as a multiple of that of
        predicting no change on the same transitions, NaN where none counts or nothing changes.
    """
    still = rows.loc[rows["predict"] == "nothing", [*MEASUREMENT, "normalised"]]
    unit = rows[MEASUREMENT].merge(still, how="left", on=MEASUREMENT)["normalised"].set_axis(rows.index)
    share = rows["normalised"] / unit.where(unit > 0)
    found = rows.assign(share=share)
    found.insert(0, "folder", folder)
    found.insert(1, "seed", seed)
    return found


def errors(rows: pd.DataFrame, probe: str, model: str, unit: str) -> Curves:
    """The error of a model on a probe over the training steps, a curve for each run of each folder.

    Args:
        rows: see `with_shares`.
        probe: ``seen``, ``next``, ...
        model: what it predicts: ``delta``, ``next`` or ``nothing``.
        unit: ``mse``, ``normalised`` or ``share``.
    """
    own = rows[(rows["probe"] == probe) & (rows["predict"] == model)]
    return curves(own, "env_steps", unit, runs=("folder", "run"))


def mean_error(rows: pd.DataFrame, probe: str, model: str, unit: str) -> tuple[np.ndarray, ...]:
    """The mean of `errors` over runs, at the steps at which every run that has got so far has a number.

    Returns:
        The steps, and there the mean, the ends of its interval and the number of runs, ``[X]`` each.
    """
    shared = errors(rows, probe, model, unit).shared
    return shared.x, *over_runs(shared.y, mean)


def late_share(rows: pd.DataFrame, probe: str, model: str) -> tuple[float, float, float]:
    """Error over the last part of training as a share of the error of predicting no change.

    For each run the sum of its errors over the sum of those of predicting no change, so that a measurement in which
    little moves counts little; then the mean over the runs that have one.

    Returns:
        The share, and the ends of its interval; NaN where there is no number.
    """
    late = rows[(rows["probe"] == probe) & (rows["env_steps"] > first_late_step(rows))]
    by_model = late.pivot(index=["folder", "run", "env_steps"], columns="predict", values="normalised")
    pairs = by_model.reindex(columns=[model, "nothing"])
    pairs = pairs[np.isfinite(pairs.to_numpy()).all(axis=1)]
    error, change = (pairs[name].groupby(level=["folder", "run"]).sum() for name in pairs)
    share = (error / change.where(change > 0)).dropna().to_numpy()
    if not share.size:
        return np.nan, np.nan, np.nan
    value, low, high, _ = over_runs(share[:, None], mean)
    return float(value[0]), float(low[0]), float(high[0])


def first_late_step(rows: pd.DataFrame) -> int:
    """Training steps after which the last part begins."""
    return round((1 - LAST) * int(rows["env_steps"].max()))
