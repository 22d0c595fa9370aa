"""Fig. 2's tests: how the retrained designs of two arms differ, over designs and over the runs that chose them.

The paper's test takes every design for a sample of its own. Those of one run are not: they share the weights, the data
and the luck that chose them. In 2000 simulated studies without any difference between arms, of five runs with five
designs each, with deviations of 1 between runs, 0.5 between the designs of a run and 0.5 between two trainings on a
design, this is found at a level of 5 % (the tests of this module repeat the first two rows):

==========================================  =====================  =========================  ===========
rejected by                                 best half of each run  best half of all together  all designs
==========================================  =====================  =========================  ===========
Welch's test over designs                   23 %                   38 %                       34 %
Welch's test over one mean for each run     5 %                    14 %                       5 %
bootstrap over runs, 0 not in the interval  13 %                   29 %                       14 %
==========================================  =====================  =========================  ===========

So the best half of each run is retrained, and a mean for each run is the sample: of the best of all runs together, what
passes one threshold is alike, and less is left of how much runs differ. Five runs are few for a bootstrap.

A body that several runs chose counts as often as it was chosen: an arm that always proposes a good one has earned it,
and each is retrained by itself, with weights of its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from coim.experiments.frames import at, read_frame, rows_of
from coim.experiments.statistics.intervals import CONFIDENCE, RESAMPLES, SEED, holm
from coim.experiments.statistics.measures import welch
from coim.experiments.study.arms import in_order, pairs_of_arms
from coim.experiments.study.runs import CHOSEN, Place, Run, runs_of_folder, trained_in

TESTS = ("welch_designs_p", "welch_runs_p")


def by_place(rows: pd.DataFrame) -> dict[Place, dict[str, pd.DataFrame]]:
    """Retrained designs of each arm, in each environment and task."""
    places = rows[["environment", "task"]].drop_duplicates().itertuples(index=False, name=None)
    return {place: {arm: at(rows, place, arm) for arm in in_order(at(rows, place)["arm"])} for place in places}


def sizes(own: pd.DataFrame) -> dict[str, int]:
    """How many designs there are, how many distinct bodies among them, and how many runs they come from."""
    return {"designs": len(own), "bodies": own["xi"].nunique(), "runs": len(by_run(own))}


def by_run(own: pd.DataFrame) -> list[np.ndarray]:
    """Best returns of one arm's retrained designs, those of a run together."""
    return [rows["best_return"].to_numpy() for _, rows in own.groupby(["seed", "run"], sort=False)]


def pairs(rows: pd.DataFrame) -> pd.DataFrame:
    """Compare arms.

    Args:
        rows: retrained designs, see `results`.

    Returns:
        A row for each pair of arms that is compared, in each environment and task; empty if there is none.
    """
    table = pd.DataFrame(
        {"environment": place[0], "task": place[1], "arm": arm, "against": against} | pair(own[arm], own[against])
        for place, own in by_place(rows).items()
        for arm, against in pairs_of_arms(list(own))
    )
    for test in TESTS if len(table) else ():
        table[f"{test}_holm"] = holm(table[test])
    return table


def pair(mine: pd.DataFrame, theirs: pd.DataFrame) -> dict[str, Any]:
    """Two arms in one environment and task."""
    x, y = by_run(mine), by_run(theirs)
    low, high = interval_over_runs(x, y)
    designs = welch(np.concatenate(x), np.concatenate(y))
    runs = welch(*(np.array([returns.mean() for returns in side]) for side in (x, y)))
    return (
        sizes(mine)
        | {f"{name}_against": count for name, count in sizes(theirs).items()}
        | {"difference": float(np.concatenate(x).mean() - np.concatenate(y).mean())}
        | {"difference_low": low, "difference_high": high}
        | {"welch_designs_p": designs, "welch_designs_p_holm": math.nan}
        | {"welch_runs_p": runs, "welch_runs_p_holm": math.nan}
    )


def interval_over_runs(x: Sequence[np.ndarray], y: Sequence[np.ndarray]) -> tuple[float, float]:
    """Percentile bootstrap interval of the difference of two arms' means over designs; runs are drawn, not designs.

    Args:
        x: returns of the designs of each run of one arm.
        y: those of the other arm.

    Returns:
        Lower and upper end; NaN where an arm has less than two runs, which say nothing about their spread.
    """
    if min(len(x), len(y)) < 2:
        return math.nan, math.nan
    rng, means = np.random.default_rng(SEED), []
    for side in (x, y):
        drawn = rng.integers(len(side), size=(RESAMPLES, len(side)))
        totals, counts = (np.array([part(returns) for returns in side]) for part in (np.sum, np.size))
        means.append(totals[drawn].sum(1) / counts[drawn].sum(1))
    low, high = np.quantile(means[0] - means[1], [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


def results(folder: Path, listed: pd.DataFrame) -> tuple[pd.DataFrame, int]:
    """Best returns of the retrainings that are over.

    One that diverged counts with the best return that it had; if it had none, with the lowest of its environment and
    task.

    Args:
        folder: ``retrained/`` of the study.
        listed: designs that were chosen, with the columns of `coim.experiments.study.runs.CHOSEN`.

    Returns:
        A row for each, and the number of those left out: without a return, as all of their environment and task.
    """
    rows = [
        result(line, run)
        for line in rows_of(listed)
        for name, place in [trained_in(line)]
        for run in runs_of_folder(folder / "cells" / name, line["environment"], line["task"], line["arm"], line["seed"])
        if run.over and run.number == place
    ]
    if not rows:
        return pd.DataFrame(), 0
    over = pd.DataFrame(rows)
    lowest = over.groupby(["environment", "task"])["lowest_return"].transform("min")
    over["best_return"] = over["best_return"].fillna(lowest)
    kept = over.drop(columns="lowest_return").dropna(subset="best_return")
    counts = [
        pd.DataFrame(sizes(designs), index=designs.index) for own in by_place(kept).values() for designs in own.values()
    ]
    if not counts:
        return kept, len(over)
    return kept.join(pd.concat(counts).add_prefix("arm_")), len(over) - len(kept)


def with_retrained(measured: pd.DataFrame, study: Path) -> pd.DataFrame:
    """Add what came of the best body of each run, by its return in the study, when it was trained from scratch.

    Args:
        measured: a row for each run, see `coim.experiments.statistics.measures.measures`.
        study: its folder.

    Returns:
        The same rows with ``retrained``, the best return of that training; NaN where there was none yet. Where only a
        share of a run's designs may be retrained, such as the optimised ones, it is the best of these.
    """
    run = ["environment", "task", "arm", "seed", "run"]
    folder = study / "retrained"
    listed = read_frame(folder / CHOSEN.file, CHOSEN)
    rows, _ = results(folder, listed)
    if rows.empty:
        return measured.assign(retrained=math.nan)
    best = listed.sort_values("found_return", kind="stable").drop_duplicates(run, keep="last")[[*run, "design"]]
    found = best.merge(rows[[*run, "design", "best_return"]], on=[*run, "design"])
    return measured.merge(found.rename(columns={"best_return": "retrained"})[[*run, "retrained"]], how="left", on=run)


def result(line: Mapping[str, Any], run: Run) -> dict[str, Any]:
    """A row of the CSV file; ``replaced`` is 1 where another return is to stand for one that there is not."""
    settings, returns = run.record.settings, run.designs["best_return"]
    return (
        {name: line[name] for name in ("environment", "task", "arm", "seed", "run", "design", "xi")}
        | {"found_return": line["found_return"], "best_return": returns.max(), "lowest_return": returns.min()}
        | {"diverged": int(run.diverged), "replaced": int(run.designs.empty)}
        | {"episodes": settings["first_episodes"], "study_episodes": settings["episodes"]}
        | {"found": line["found"], "kept": line["kept"]}
    )
