"""What a run comes to in a few numbers, and how two arms differ in one of them."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.optimize import brentq

from coim.experiments.run.records import Row
from coim.experiments.statistics.intervals import holm, improvement, interval, mean
from coim.experiments.study.arms import pairs_of_arms
from coim.experiments.study.runs import Run, Runs

Cells = dict[str, object]
MEASURES = ("area", "final")
ALPHA, POWER = 0.05, 0.8

NO_PAIRS: Cells = {"paired_difference_low": math.nan, "paired_difference_high": math.nan}


@dataclass(frozen=True)
class Measured:
    """Numbers of one run.

    Attributes:
        run: whose they are.
        area: under the best-return curve of Fig. 1, over the number of designs: the mean best return of a design.
        final: the highest best return of all designs: what is in hand when the budget is spent.
        search_gain: mean best return of the designs that maximised Q minus that of the random ones, which take turns.
        correlation: Spearman's, of the prediction Q(xi) before a body was built and the best return on it, over the
            bodies that came after the first ones.
        correlation_given_order: the same with the order of building held fixed: Q and returns both rise while the
            networks learn, whatever the body.
        bias_optimised: mean of prediction minus best return over the designs that maximised Q, both as reward per
            step; see `predictions`.
        bias_random: the same over random designs.
        hours: wall-clock of the cell.
        episode_seconds: median over the training episodes, their updates and evaluation included; NaN without a
            ``metrics.csv``.
        updates: of all learners and the ensemble.

    All but the last three are NaN while they are not known; area, final and search_gain while the run is under way.
    """

    run: Run
    area: float
    final: float
    search_gain: float
    correlation: float
    correlation_given_order: float
    bias_optimised: float
    bias_random: float
    hours: float
    episode_seconds: float
    updates: int


def measure(run: Run, failure: float) -> Measured:
    """A diverged run counts with ``failure`` on each design that it did not reach."""
    values = run.best_returns(failure) if run.over else np.array([math.nan])
    chosen = [row for row in predictions(run) if row["kind"] != "first"]
    if len({row["xi"] for row in chosen}) < 2:
        chosen = []  # of one body alone there is nothing to rank
    settings, rows = run.record.settings, [row for row in run.record.episodes if row["run"] == run.number]
    an_episode = settings["individual_updates"] + settings["population_updates"]
    learns_model = settings["imagine"] != "none" and settings.get("dream") != "simulator"
    an_episode += settings["model_updates"] * learns_model
    return Measured(
        run,
        area=float(values.mean()),
        final=float(values.max()),
        search_gain=best_mean(run, "optimised") - best_mean(run, "random") if run.over else math.nan,
        correlation=spearman(chosen, "predicted", "best_return"),
        correlation_given_order=spearman_given(chosen, "predicted", "best_return", given="design"),
        bias_optimised=bias([row for row in chosen if row["kind"] == "optimised"]),
        bias_random=bias([row for row in chosen if row["kind"] == "random"]),
        hours=max(row["seconds"] for row in run.record.episodes) / 3600,
        episode_seconds=float(np.median([row.get("seconds/episode", math.nan) for row in rows])),
        updates=len(rows) * an_episode,
    )


def best_mean(run: Run, kind: str) -> float:
    """Mean best return of a run's designs of one kind; NaN where there is none."""
    values = [row["best_return"] for row in run.designs if row["kind"] == kind]
    return float(np.mean(values)) if values else math.nan


def spearman(rows: Sequence[Row], one: str, other: str) -> float:
    """Rank correlation of two columns; NaN for less than three rows, or where one of them is the same in all."""
    x, y = ([row[name] for row in rows] for name in (one, other))
    if len(rows) < 3 or len(set(x)) == 1 or len(set(y)) == 1:
        return math.nan
    return float(stats.spearmanr(x, y).statistic)


def spearman_given(rows: Sequence[Row], one: str, other: str, *, given: str) -> float:
    """Partial rank correlation of two columns with a third one held fixed.

    NaN for less than four rows, or where the third one says all of one of the others.
    """
    x_y, x_z, y_z = (spearman(rows, *pair) for pair in ((one, other), (one, given), (other, given)))
    rest = (1 - x_z**2) * (1 - y_z**2)
    return (x_y - x_z * y_z) / math.sqrt(rest) if len(rows) > 3 and rest > 1e-12 else math.nan


def bias(rows: Sequence[Row]) -> float:
    """Mean of prediction minus best return, both as reward per step; NaN for no rows."""
    errors = [row["predicted_per_step"] - row["return_per_step"] for row in rows]
    return float(np.mean(errors)) if errors else math.nan


def predictions(run: Run) -> list[Row]:
    """Designs with a prediction and a best return, both also as reward per step.

    A constant reward r has the discounted value r / (1 - gamma) and, over T steps, the return r T. So (1 - gamma) Q and
    return / T are both a mean reward per step, and agree if the reward is the same all the time. They are not the same
    mean otherwise: Q weighs the first 1 / (1 - gamma) steps after a start, the return all T alike; Q is of the
    population's policy before anything was learnt on the body, the return the best of the individual policy after it;
    and Q holds the entropy bonus of Eq. 3, of up to alpha times the entropy of an action in each step.
    """
    gamma, steps = run.record.settings["gamma"], run.record.settings["episode_steps"]
    return [
        row | {"predicted_per_step": (1 - gamma) * row["predicted"], "return_per_step": row["best_return"] / steps}
        for row in run.designs
        if math.isfinite(row["predicted"])
    ]


def comparisons(runs: Runs, measured: Sequence[Measured]) -> list[Cells]:
    """Every pair of arms by every measure, in each environment and task and, where there are several, over all.

    Holm's correction is over all tests of one measure in the study.
    """
    rows = []
    for name in MEASURES:
        own = [row for arm, against in pairs_of_arms(runs.arms) for row in compare(runs, measured, name, arm, against)]
        for test in ("welch_p", "paired_p"):
            for row, corrected in zip(own, holm([float(str(row[test])) for row in own])):
                row[f"{test}_holm"] = corrected
        rows += own
    return rows


def compare(runs: Runs, measured: Sequence[Measured], name: str, arm: str, against: str) -> Iterator[Cells]:
    """One pair of arms by one measure."""
    strata: list[np.ndarray] = []
    for place in runs.places:
        mine, theirs = (values_of(measured, name, place, which) for which in (arm, against))
        if not mine or not theirs:
            continue
        x, y = np.array(list(mine.values())), np.array(list(theirs.values()))
        strata += [x, y]
        shared = sorted(mine.keys() & theirs.keys())
        difference = np.array([mine[key] - theirs[key] for key in shared])
        yield (
            {"environment": place[0], "task": place[1], "measure": name, "arm": arm, "against": against}
            | {"runs": len(x), "runs_against": len(y), "difference": float(x.mean() - y.mean())}
            | limits("difference", lambda x, y, axis: mean(x, axis) - mean(y, axis), x, y)
            | {"improvement": float(improvement(x, y))}
            | limits("improvement", improvement, x, y)
            | {"welch_p": welch(x, y), "welch_p_holm": math.nan, "detectable": detectable(x, y)}
            | {"pairs": len(shared), "paired_difference": float(difference.mean()) if shared else math.nan}
            | (limits("paired_difference", mean, difference) if shared else NO_PAIRS)
            | {"paired_p": paired(difference), "paired_p_holm": math.nan}
        )
    if len(strata) > 2:
        count, count_against = (sum(map(len, strata[side::2])) for side in (0, 1))
        nothing = dict.fromkeys(("difference", "difference_low", "difference_high"), math.nan)  # scales differ
        yield (
            {"environment": "all", "task": "all", "measure": name, "arm": arm, "against": against}
            | {"runs": count, "runs_against": count_against}
            | nothing
            | {"improvement": float(improvement(*strata))}
            | limits("improvement", improvement, *strata)
            | {"welch_p": math.nan, "welch_p_holm": math.nan, "detectable": math.nan}
            | {"pairs": 0, "paired_difference": math.nan}
            | NO_PAIRS
            | {"paired_p": math.nan, "paired_p_holm": math.nan}
        )


def values_of(
    measured: Sequence[Measured], name: str, place: tuple[str, str], arm: str
) -> dict[tuple[int, int], float]:
    """A measure of the runs that are over, by seed and number: what pairs them with another arm's."""
    own = [m for m in measured if ((m.run.environment, m.run.task), m.run.arm) == (place, arm) and m.run.over]
    return {(m.run.seed, m.run.number): getattr(m, name) for m in own if math.isfinite(getattr(m, name))}


def limits(name: str, statistic, *samples: np.ndarray) -> Cells:
    """A bootstrap interval as two cells."""
    low, high = interval(statistic, *samples)
    return {f"{name}_low": float(low), f"{name}_high": float(high)}


def welch(x: np.ndarray, y: np.ndarray) -> float:
    """Two-sided p of Welch's t-test; NaN for less than two runs, or no spread at all."""
    if min(len(x), len(y)) < 2 or np.ptp(x) == np.ptp(y) == 0:
        return math.nan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # one arm without spread, such as all diverged, is no mistake
        return float(stats.ttest_ind(x, y, equal_var=False).pvalue)


def detectable(x: np.ndarray, y: np.ndarray) -> float:
    """Difference of two arms, with the spreads and numbers of these runs, that Welch's test finds in 80 % of studies.

    Found: a two-sided p below 5 %, before any correction for other tests. NaN where the test has no number, or hardly
    more than one degree of freedom.

    Example:
        >>> round(detectable(np.arange(5.0), np.arange(5.0)), 2)  # of five runs each, two standard deviations
        3.2
    """
    if math.isnan(welch(x, y)):
        return math.nan
    error = math.sqrt(x.var(ddof=1) / len(x) + y.var(ddof=1) / len(y))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        freedom = stats.ttest_ind(x, y, equal_var=False).df
        bar = stats.t.isf(ALPHA / 2, freedom)

        def lacking(effect: float) -> float:
            return POWER - stats.nct.sf(bar, freedom, effect) - stats.nct.cdf(-bar, freedom, effect)

        high = 1.0  # in standard errors
        while lacking(high) > 0:
            high *= 2
        return float(error * brentq(lacking, 0.0, high)) if lacking(high) <= 0 else math.nan


def paired(difference: np.ndarray) -> float:
    """Two-sided p of the paired t-test on the differences of runs that share seed and first designs.

    Not Wilcoxon's: of five pairs its smallest two-sided p is 1/16, so that it could never find anything at 5 %.
    """
    if len(difference) < 2 or np.ptp(difference) == 0:
        return math.nan
    return float(stats.ttest_1samp(difference, 0.0).pvalue)
