"""What was predicted of bodies before they were built, against the best returns on them."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from coim.experiments.frames import design_columns_of
from coim.experiments.study.runs import Run


def predictions(run: Run) -> pd.DataFrame:
    """Designs with a prediction and a best return, both also as reward per step.

    The prediction is that of what chose the bodies: the return ``expected`` by a posterior, in a run that has one, and
    Eq. 5 in any other.

    A constant reward r has the discounted value r / (1 - gamma) and, over T steps, the return r T. So (1 - gamma) Q and
    return / T are both a mean reward per step, and agree if the reward is the same all the time. They are not the same
    mean otherwise: Q weighs the first 1 / (1 - gamma) steps after a start, the return all T alike; Q is of the
    population's policy before anything was learnt on the body, the return the best of the individual policy after it;
    and Q holds the entropy bonus of Eq. 3, of up to alpha times the entropy of an action in each step.
    """
    gamma, steps = run.record.settings["gamma"], run.record.settings["episode_steps"]
    rows = run.designs
    expects = bool(rows["expected"].notna().any())
    if expects:
        rows = rows.assign(predicted=rows["expected"])
    rows = rows[np.isfinite(rows["predicted"])]
    return rows.assign(
        predicted_per_step=rows["predicted"] / steps if expects else (1 - gamma) * rows["predicted"],
        return_per_step=rows["best_return"] / steps,
    )


def later_predictions(run: Run) -> pd.DataFrame:
    """`predictions` after the first designs, which are given; none of a run that has one body alone."""
    rows = predictions(run)
    rows = rows[rows["kind"] != "first"]
    return rows if len(rows[design_columns_of(rows)].drop_duplicates()) > 1 else rows[:0]


def bias(rows: pd.DataFrame) -> float:
    """Mean of prediction minus best return, both as reward per step; NaN for no rows."""
    errors = (rows["predicted_per_step"] - rows["return_per_step"]).to_numpy()
    return float(np.mean(errors)) if len(errors) else math.nan
