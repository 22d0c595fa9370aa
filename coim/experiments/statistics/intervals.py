"""Means over runs with their intervals.

Shapes: R runs.

References:
    Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (`rliable`): the
    interquartile mean, percentile intervals of the stratified bootstrap, and the probability of improvement.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

CONFIDENCE = 0.95
RESAMPLES = 2000  # as rliable
FEW = (  # measured by the tests of this module
    "A percentile bootstrap of few runs is too narrow: of normally distributed returns, its 95 % interval of the mean "
    "(of the IQM) holds the truth in 76% (76%) of studies with 3 runs, 84% (91%) with 5 and 90% (94%) with 10."
)
SEED = 0  # of the resampling: a figure that is drawn again is the same figure

Statistic = Callable[..., np.ndarray]


def mean(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Over one axis."""
    return np.mean(values, axis=axis)


def iqm(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Interquartile mean: of the middle half of the values, those at its edges counting in part.

    `scipy.stats.trim_mean` drops whole values, of five runs one on each side: the middle 60 %. Here each sorted value
    stands for the n-th part of the distribution and weighs as much of it as lies between the quartiles. Where n is a
    multiple of 4 the two agree.

    Example:
        >>> float(iqm(np.array([0.0, 1.0, 2.0, 3.0, 100.0])))  # weights 0, .3, .4, .3, 0
        2.0
    """
    size = values.shape[axis]
    edges = np.clip(np.arange(size + 1) / size, 0.25, 0.75)
    return np.moveaxis(np.sort(values, axis=axis), axis, -1) @ (np.diff(edges) / 0.5)


def interval(statistic: Statistic, *samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Percentile bootstrap interval of a statistic of one or several samples.

    Each sample is drawn anew by itself: one sample per stratum (environment, task, arm) is the stratified bootstrap.

    Args:
        statistic: of the samples, along its keyword ``axis``.
        samples: ``[R_i, *]`` each; a run is drawn as a whole, all its columns together.

    Returns:
        Lower and upper end; NaN where a sample has less than two runs, which say nothing about their spread.
    """
    if min(len(sample) for sample in samples) < 2:
        nothing = np.full(np.broadcast_shapes(*(sample.shape[1:] for sample in samples)), np.nan)
        return nothing, nothing
    found = stats.bootstrap(
        samples,
        statistic,
        axis=0,
        vectorized=True,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(SEED),
    ).confidence_interval
    return np.asarray(found.low), np.asarray(found.high)


def over_runs(values: np.ndarray, statistic: Statistic) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A curve over runs with its pointwise interval, from the runs that have a number at each point.

    Args:
        values: ``[R, X]``, NaN where a run has no number.
        statistic: such as `iqm`.

    Returns:
        Value, lower end, upper end and number of runs, ``[X]`` each.
    """
    known = np.isfinite(values)
    value, low, high = (np.full(values.shape[1], np.nan) for _ in range(3))
    for there in np.unique(known, axis=1).T:  # points with the same runs are resampled together
        if there.any():
            points = (known == there[:, None]).all(0)
            block = values[np.ix_(there, points)]
            value[points] = statistic(block, axis=0)
            low[points], high[points] = interval(statistic, block)
    return value, low, high, known.sum(0)


def improvement(*samples: np.ndarray, axis: int = -1) -> np.ndarray:
    """Probability of improvement: that a run of one arm beats a run of another; ties count half.

    Args:
        samples: x_1, y_1, x_2, y_2, ...: both arms in each stratum. The strata count alike, as in `rliable`.
        axis: of the runs.

    Returns:
        The mean over strata of P(x > y) + P(x = y) / 2, the Mann-Whitney U over the number of pairs.

    Example:
        >>> float(improvement(np.array([1.0, 3.0]), np.array([2.0, 1.0])))  # 1 = 1, 1 < 2, 3 > 2, 3 > 1
        0.625
    """
    chances = []
    for x, y in zip(samples[::2], samples[1::2]):
        better = np.sign(np.moveaxis(x, axis, -1)[..., :, None] - np.moveaxis(y, axis, -1)[..., None, :])
        chances.append((1 + better.mean((-2, -1))) / 2)
    return np.mean(chances, axis=0)


def holm(p_values: ArrayLike) -> list[float]:
    """P-values of a family of tests, corrected by Holm's step-down method; NaN stays and does not count.

    Example:
        >>> holm([0.01, 0.04, 0.03])  # 3 x .01; 2 x .03; .04, but not below the one before
        [0.03, 0.06, 0.06]
    """
    p = np.asarray(p_values, dtype=float).tolist()
    order = [i for i in np.argsort(p).tolist() if np.isfinite(p[i])]
    corrected, least = [float("nan")] * len(p), 0.0
    for rank, i in enumerate(order):
        least = max(least, min(1.0, (len(order) - rank) * p[i]))
        corrected[i] = least
    return corrected
