"""Measure runs in a few numbers, and compare two arms by one of them."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats
from scipy.optimize import brentq

from coim.experiments.frames import at, spearman, spearman_given
from coim.experiments.predictions import coverage, worth_of_search
from coim.experiments.statistics.intervals import Statistic, holm, improvement, interval, mean
from coim.experiments.statistics.predicted import bias, later_predictions
from coim.experiments.study.arms import pairs_of_arms
from coim.experiments.study.runs import Place, Run, Runs

Cells = dict[str, object]
MEASURES = ("area", "final")
COMPARED = (*MEASURES, "retrained")
ALPHA, POWER = 0.05, 0.8

NO_PAIRS: Cells = {"paired_difference_low": math.nan, "paired_difference_high": math.nan}


def measures(runs: Runs) -> pd.DataFrame:
    """Measure every run of a study.

    Args:
        runs: those that have begun are measured.

    Returns:
        A row for each run, with what `measure` gives, in the order of the ledger.
    """
    columns = ["environment", "task", "arm", "seed", "run", "state", "over", "diverged", "designs", "planned", *NUMBERS]
    rows = []
    for run in runs.found:
        place = run.environment, run.task
        rows.append(measure(run, runs.failure(place), runs.kinds(place, run.arm)))
    found = pd.DataFrame(rows, columns=columns)
    return found.astype({"over": bool} | dict.fromkeys(MEASURES, float))  # also where there are no runs


NUMBERS = (
    "area",
    "final",
    "search_gain",
    "rank_correlation",
    "rank_correlation_raw",
    "coverage",
    "bias_optimised",
    "bias_random",
    "hours",
    "episode_seconds",
    "updates",
)


def measure(run: Run, failure: float, kinds: Mapping[int, str]) -> dict[str, Any]:
    """Measure one run.

    Args:
        run: of a study.
        failure: counts as the best return of a diverged run on each design that it did not reach.
        kinds: of the designs of its arm, by their numbers: what the designs that it did not reach would have been.

    Returns:
        What names the run (``environment``, ``task``, ``arm``, ``seed``, ``run``); its ``state``, whether it is
        ``over`` or ``diverged``, how many ``designs`` it has tried of those ``planned``; and its `NUMBERS`:

        ``area``
            under the best-return curve of Fig. 1, over the number of designs: the mean best return of a design.
        ``final``
            the highest best return of all designs: what is in hand when the budget is spent.
        ``search_gain``
            mean best return of the designs that were searched for minus that of the random ones, which take turns.
        ``rank_correlation``
            Spearman's, of the prediction before a body was built and the best return on it, over the bodies that came
            after the first ones, with the order of building held fixed: predictions and returns both rise while the
            networks learn, whatever the body. For what predicts see `statistics.predicted`.
        ``rank_correlation_raw``
            the same without holding the order fixed.
        ``coverage``
            share of these best returns within the 90 % interval of what a posterior expected. The deviation of
            ``designs.csv`` holds how much the returns of one body vary, so that a return can be held against it.
        ``bias_optimised``
            mean of prediction minus best return over the designs that were searched for, both as reward per step.
        ``bias_random``
            the same over random designs.
        ``hours``
            wall-clock of the cell.
        ``episode_seconds``
            median over the training episodes, their updates and evaluation included; NaN without a ``metrics.csv``.
        ``updates``
            of all learners and the ensemble.

        All but the last three are NaN while they are not known; area, final and search_gain while the run is under way.
    """
    values = run.best_returns(failure) if run.over else np.array([math.nan])
    by_kind = pd.DataFrame({"kind": [kinds.get(i + 1) for i in range(len(values))], "best_return": values})
    chosen = later_predictions(run)
    settings, rows = run.record.settings, run.record.episodes
    own = rows[rows["run"] == run.number]
    an_episode = settings["individual_updates"] + settings["population_updates"]
    learns_model = settings["imagine"] != "none" and settings.get("dream") != "simulator"
    an_episode += settings["model_updates"] * learns_model
    return {
        "environment": run.environment,
        "task": run.task,
        "arm": run.arm,
        "seed": run.seed,
        "run": run.number,
        "state": run.state,
        "over": run.over,
        "diverged": run.diverged,
        "designs": len(run.designs),
        "planned": run.num_designs,
        "area": float(values.mean()),
        "final": float(values.max()),
        "search_gain": worth_of_search(by_kind).value,
        "rank_correlation": spearman_given(chosen["predicted"], chosen["best_return"], given=chosen["design"]),
        "rank_correlation_raw": spearman(chosen["predicted"], chosen["best_return"]),
        "coverage": coverage(chosen).share,
        "bias_optimised": bias(chosen[chosen["kind"] == "optimised"]),
        "bias_random": bias(chosen[chosen["kind"] == "random"]),
        "hours": float(rows["seconds"].max()) / 3600,
        "episode_seconds": float(np.median(own.get("seconds/episode", math.nan))),
        "updates": len(own) * an_episode,
    }


def comparisons(runs: Runs, measured: pd.DataFrame) -> pd.DataFrame:
    """Compare every arm with its baselines by every measure, in each environment and task and over all of them.

    Holm's correction is over all tests of one measure in the study.

    Args:
        runs: of the study.
        measured: see `measures` and `coim.experiments.statistics.retrained.with_retrained`.

    Returns:
        A row for each comparison; empty where there is none.
    """
    tables = []
    for name in COMPARED:
        known = measured[measured["over"] & np.isfinite(measured[name])]
        pairs = pairs_of_arms(runs.arms)
        table = pd.DataFrame([row for arm, against in pairs for row in compare(runs, known, name, arm, against)])
        for test in ("welch_p", "paired_p") if len(table) else ():
            table[f"{test}_holm"] = holm(table[test])
        tables += [table] if len(table) else []
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def compare(runs: Runs, known: pd.DataFrame, name: str, arm: str, against: str) -> Iterator[Cells]:
    """Compare one pair of arms by one measure, which all of these runs have."""
    strata: list[np.ndarray] = []
    for place in runs.places:
        mine, theirs = (values_of(known, name, place, which) for which in (arm, against))
        if mine.empty or theirs.empty:
            continue
        x, y = mine.to_numpy(), theirs.to_numpy()
        strata += [x, y]
        difference = (mine - theirs).dropna().to_numpy()  # of the runs that share seed and number
        shared = len(difference)
        yield (
            {"environment": place[0], "task": place[1], "measure": name, "arm": arm, "against": against}
            | {"runs": len(x), "runs_against": len(y), "difference": float(x.mean() - y.mean())}
            | limits("difference", lambda x, y, axis: mean(x, axis) - mean(y, axis), x, y)
            | {"improvement": float(improvement(x, y))}
            | limits("improvement", improvement, x, y)
            | {"welch_p": welch(x, y), "welch_p_holm": math.nan, "detectable": detectable(x, y)}
            | {"pairs": shared, "paired_difference": float(difference.mean()) if shared else math.nan}
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


def values_of(measured: pd.DataFrame, name: str, place: Place, arm: str) -> pd.Series:
    """A measure of an arm by seed and number of the run, which pair it with another arm's."""
    return at(measured, place, arm).set_index(["seed", "run"])[name]


def limits(name: str, statistic: Statistic, *samples: np.ndarray) -> Cells:
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
    more than one degree of freedom. The degrees of freedom are taken as they were found, though they vary from study to
    study: with few runs the difference is found less often, in 20,000 simulated studies in 80 % of them with ten runs
    of each arm, 77 % with five and 69 % with three.

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
