"""Returns that were predicted of bodies against those achieved, and what a search of bodies was worth.

Shapes: N bodies, R runs.

References:
    B. L. Welch, *The generalization of "Student's" problem when several different population variances are involved*,
    Biometrika 34, 1947: the interval of a difference of means.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import stats

from coim.run_folder import EXPECTED

LEVEL = 0.9  # of the interval of a prediction
CONFIDENCE = 0.95  # of the interval of a difference or a mean


def prediction_interval(expected: ArrayLike, deviation: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Central 90 % interval of the best return of a body, normally distributed.

    Args:
        expected: mean, ``[N]``.
        deviation: standard deviation with the noise of one best return, ``[N]``; see `coim.DesignChosen`.

    Returns:
        Lower and upper end, ``[N]`` each.

    Example:
        >>> [end.round(1).tolist() for end in prediction_interval([100.0], [10.0])]
        [[83.6], [116.4]]
    """
    half = stats.norm.ppf((1 + LEVEL) / 2) * np.asarray(deviation, dtype=float)
    return np.asarray(expected, dtype=float) - half, np.asarray(expected, dtype=float) + half


@dataclass(frozen=True)
class Coverage:
    """How many best returns lie within the 90 % intervals that were predicted of them.

    Attributes:
        inside: best returns that do.
        total: best returns that have an interval.
    """

    inside: int
    total: int

    @property
    def share(self) -> float:
        """Share of best returns within their interval; NaN without any."""
        return self.inside / self.total if self.total else math.nan

    @property
    def by_chance(self) -> tuple[int, int]:
        """Least and largest number inside, in 95 % of all cases, of intervals that are right."""
        low, high = stats.binom.interval(CONFIDENCE, self.total, LEVEL)
        return int(low), int(high)


def coverage(designs: pd.DataFrame) -> Coverage:
    """Count the best returns within the intervals predicted of them.

    Args:
        designs: rows with ``expected``, ``deviation`` and ``best_return``; those that lack one are left out.

    Example:
        >>> rows = pd.DataFrame({"expected": [100.0, 100.0], "deviation": [10.0, 10.0], "best_return": [110.0, 120.0]})
        >>> coverage(rows)
        Coverage(inside=1, total=2)
    """
    rows = foretold(designs)
    low, high = prediction_interval(rows["expected"], rows["deviation"])
    return Coverage(int(rows["best_return"].between(low, high).sum()), len(rows))


def foretold(designs: pd.DataFrame) -> pd.DataFrame:
    """Rows of designs with a best return and an interval that was predicted of it."""
    return designs[np.isfinite(designs[[*EXPECTED, "best_return"]].to_numpy(dtype=float)).all(1)]


@dataclass(frozen=True)
class Estimate:
    """A number and the 95 % interval around it; the ends are NaN where too little is known to have one."""

    value: float
    low: float
    high: float


def difference(x: ArrayLike, y: ArrayLike) -> Estimate:
    """Mean of one sample minus that of another, with Welch's interval.

    Args:
        x: ``[N]``.
        y: any number of values.

    Returns:
        NaN ends where a sample has less than two values, or both have no spread; all NaN where one is empty.

    Example:
        >>> found = difference([3.0, 5.0], [1.0, 3.0])  # t of 2 degrees of freedom is 4.30, the standard error 1.41
        >>> round(found.value, 2), round(found.low, 2), round(found.high, 2)
        (2.0, -4.08, 8.08)
    """
    one, other = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    value = float(one.mean() - other.mean()) if min(one.size, other.size) else math.nan
    if min(one.size, other.size) < 2 or one.std() == other.std() == 0:
        return Estimate(value, math.nan, math.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # one sample without spread is no mistake
        low, high = stats.ttest_ind(one, other, equal_var=False).confidence_interval(CONFIDENCE)
    return Estimate(value, float(low), float(high))


def mean_of_runs(values: ArrayLike) -> Estimate:
    """Mean over runs ``[R]`` with Student's interval; NaN ends for less than two runs or without spread.

    Example:
        >>> found = mean_of_runs([1.0, 3.0])  # t of 1 degree of freedom is 12.7, the standard error 1
        >>> round(found.value, 1), round(found.low, 1), round(found.high, 1)
        (2.0, -10.7, 14.7)
    """
    runs = np.asarray(values, dtype=float)
    value = float(runs.mean()) if runs.size else math.nan
    if runs.size < 2 or runs.std() == 0:
        return Estimate(value, math.nan, math.nan)
    low, high = stats.ttest_1samp(runs, 0.0).confidence_interval(CONFIDENCE)
    return Estimate(value, float(low), float(high))


def worth_of_search(designs: pd.DataFrame) -> Estimate:
    """Mean best return of a run's optimised bodies minus that of its random ones, which take turns.

    With an odd number of later bodies both have the same mean place in the order of building. With an even one, as in
    the paper's protocol, random bodies are built one place later, when the controller has learnt more: what a body
    gains by its place is then counted against the search.

    Args:
        designs: rows of one run with ``kind`` and ``best_return``, all finite.
    """
    optimised, random = (designs["best_return"][designs["kind"] == kind] for kind in ("optimised", "random"))
    return difference(optimised, random)
