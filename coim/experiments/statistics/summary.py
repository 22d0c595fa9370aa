"""Summary of a study: each measure of each arm, its mean over runs and the interval of this mean."""

from __future__ import annotations

import pandas as pd

from coim.experiments.frames import at
from coim.experiments.statistics.intervals import interval, mean
from coim.experiments.study.runs import Place, Runs

SUMMARISED = ("search_gain", "area", "final", "rank_correlation", "coverage", "retrained")
COLUMNS = ["environment", "arm", "measure", "mean", "low", "high", "runs"]


def summary(runs: Runs, measured: pd.DataFrame) -> pd.DataFrame:
    """Summarise the runs that are over.

    Args:
        runs: of the study.
        measured: see `coim.experiments.statistics.measures.measures`, with `with_retrained`.

    Returns:
        A row for each environment, arm and measure, with the columns `COLUMNS`: the mean over runs, its 95 % bootstrap
        interval (NaN for a single run) and the number of runs that have the measure. There is no row where no run has
        it, such as the coverage of an arm that expects no return.
    """
    over = measured[measured["over"]]
    rows = [
        (named(place), arm, name, float(mean(values)), *map(float, interval(mean, values)), len(values))
        for place in runs.places
        for arm in runs.arms_at(place)
        for name in SUMMARISED
        if len(values := at(over, place, arm)[name].dropna().to_numpy())
    ]
    return pd.DataFrame(rows, columns=COLUMNS)


def named(place: Place) -> str:
    """Environment, with its task unless that is the usual one.

    Example:
        >>> named(("hopper", "forward")), named(("hopper", "backward"))
        ('hopper', 'hopper-backward')
    """
    environment, task = place
    return environment if task == "forward" else f"{environment}-{task}"
