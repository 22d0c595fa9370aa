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
and each is retrained with its own seed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from coim.experiments.statistics.intervals import CONFIDENCE, RESAMPLES, SEED, holm
from coim.experiments.statistics.measures import welch
from coim.experiments.study.arms import in_order, pairs_of_arms
from coim.experiments.study.runs import Place, Run, runs_of_folder

Line = dict[str, str]

TESTS = ("welch_designs_p", "welch_runs_p")
Cells = dict[str, object]


def by_place(rows: Sequence[Cells]) -> dict[Place, dict[str, list[Cells]]]:
    """Retrained designs of each arm, in each environment and task."""
    found: dict[Place, list[Cells]] = {}
    for row in rows:
        found.setdefault((str(row["environment"]), str(row["task"])), []).append(row)
    return {
        place: {arm: [row for row in own if row["arm"] == arm] for arm in in_order(str(row["arm"]) for row in own)}
        for place, own in found.items()
    }


def sizes(own: Sequence[Cells]) -> dict[str, int]:
    """How many designs there are, how many distinct bodies among them, and how many runs they come from."""
    return {"designs": len(own), "bodies": len({row["xi"] for row in own}), "runs": len(by_run(own))}


def by_run(own: Sequence[Cells]) -> list[np.ndarray]:
    """Best returns of one arm's retrained designs, those of a run together."""
    found: dict[tuple[object, object], list[object]] = {}
    for row in own:
        found.setdefault((row["seed"], row["run"]), []).append(row["best_return"])
    return [np.array(returns, dtype=float) for returns in found.values()]


def pairs(rows: Sequence[Cells]) -> list[Cells]:
    """A row for each pair of arms that is compared, in each environment and task."""
    table = [
        {"environment": place[0], "task": place[1], "arm": arm, "against": against} | pair(own[arm], own[against])
        for place, own in by_place(rows).items()
        for arm, against in pairs_of_arms(list(own))
    ]
    for test in TESTS:
        for row, corrected in zip(table, holm([float(str(row[test])) for row in table])):
            row[f"{test}_holm"] = corrected
    return table


def pair(mine: Sequence[Cells], theirs: Sequence[Cells]) -> Cells:
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


def results(folder: Path, listed: Sequence[Line]) -> tuple[list[Cells], int]:
    """Retrainings that are over.

    One that diverged counts with the best return that it had; if it had none, with the lowest of its place.

    Returns:
        A row for each, and the number of those left out: without a return, as all of their place.
    """
    over: list[tuple[Line, Run]] = []
    for line in listed:
        found = runs_of_folder(
            folder / "cells" / line["folder"], line["environment"], line["task"], line["arm"], int(line["seed"])
        )
        over += [(line, run) for run in found if run.over]
    lowest: dict[tuple[str, str], float] = {}
    for line, run in over:
        for row in run.designs:
            place = line["environment"], line["task"]
            lowest[place] = min(lowest.get(place, math.inf), row["best_return"])
    rows = [
        result(line, run, lowest[line["environment"], line["task"]])
        for line, run in over
        if (line["environment"], line["task"]) in lowest
    ]
    for own in by_place(rows).values():
        for designs in own.values():
            counts = {f"arm_{name}": count for name, count in sizes(designs).items()}
            for row in designs:
                row.update(counts)
    return rows, len(over) - len(rows)


def result(line: Line, run: Run, failure: float) -> Cells:
    """A row of the CSV file; ``replaced`` is 1 where ``failure`` stands for a return that there is not."""
    settings = run.record.settings
    return (
        {name: line[name] for name in ("environment", "task", "arm", "seed", "run", "design", "xi")}
        | {"found_return": float(line["found_return"]), "best_return": float(run.best_returns(failure).max())}
        | {"diverged": int(run.diverged), "replaced": int(not run.designs)}
        | {"episodes": settings["first_episodes"], "study_episodes": settings["episodes"]}
        | {name: int(line[name]) if line.get(name) else "" for name in ("found", "kept")}
    )
