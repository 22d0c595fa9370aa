"""How alike the best bodies of different runs are.

Shapes: R runs, D design.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

DRAWS = 4000  # of R uniform bodies, for what is to be expected by chance
CHANCE = 0.9
GIVEN = ("first", "fixed")  # kinds of bodies that no run has chosen: they are the same in every run


def distances(best: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Distance between each two bodies: root mean square over lengths of their difference as a share of the bounds.

    Args:
        best: ``[R, D]``.
        low: lowest design, ``[D]``.
        high: highest design, ``[D]``.

    Returns:
        ``[R, R]``, from 0 (the same body) to 1 (opposite corners).

    Example:
        >>> distances(np.array([[1.0, 1.0], [2.0, 1.0]]), np.array([0.0, 0.0]), np.array([2.0, 2.0])).round(3).tolist()
        [[0.0, 0.354], [0.354, 0.0]]
    """
    place = (best - low) / (high - low)
    return np.sqrt(((place[:, None] - place[None]) ** 2).mean(-1))


def mean_distance(table: np.ndarray) -> float:
    """Mean over all pairs of different runs of a table ``[R, R]``."""
    return float(table[np.triu_indices(len(table), 1)].mean())


def by_chance(num_runs: int, size: int) -> tuple[float, float]:
    """Central 90 % interval of the mean distance of uniformly drawn bodies.

    Example:
        >>> low, high = by_chance(2, 1)  # the distance of two uniform numbers has the density 2 (1 - x)
        >>> abs(low - 0.025) < 0.01, abs(high - 0.776) < 0.03
        (True, True)
    """
    drawn = np.random.default_rng(0).random((DRAWS, num_runs, size))
    pairs = np.triu_indices(num_runs, 1)
    apart = np.sqrt(((drawn[:, pairs[0]] - drawn[:, pairs[1]]) ** 2).mean(-1)).mean(1)
    low, high = np.quantile(apart, [(1 - CHANCE) / 2, (1 + CHANCE) / 2])
    return float(low), float(high)


def in_words(table: np.ndarray, size: int, kinds: Sequence[str]) -> str:
    """A sentence on the mean distance and what chance would give.

    Best bodies that were given to the runs are left out: two runs that found nothing better than the same first body
    do not agree on anything that they found.

    Args:
        table: distances of the best bodies, ``[R, R]``.
        size: D.
        kinds: how the best body of each run was chosen.
    """
    own = [run for run, kind in enumerate(kinds) if kind not in GIVEN]
    given = len(kinds) - len(own)
    left_out = f"In {given} of {len(kinds)} runs the best body is one that all runs were given. " if given else ""
    if len(own) < 2:
        return f"{left_out}Too few remain to say whether what the runs found is more alike than chance."
    found, (low, high) = mean_distance(table[np.ix_(own, own)]), by_chance(len(own), size)
    if found < low:
        verdict = "they are more alike than chance"
    elif found > high:
        verdict = "they are less alike than chance"
    else:
        verdict = "that is no more alike than chance"
    return (
        f"{left_out}Mean distance of the best bodies of {len(own)} runs: {found:.2f}; {len(own)} bodies drawn "
        f"uniformly have {low:.2f} to {high:.2f} in {CHANCE:.0%} of draws: {verdict}. 0 is the same body, "
        "1 are opposite corners."
    )
