"""Statistics of a study: each arm, each pair of arms, each prediction, and what each run took."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from coim.experiments.drawing.layout import new_figure
from coim.experiments.drawing.palette import BLACK, GREY, put_legend
from coim.experiments.figures.legend import point_entries
from coim.experiments.figures.plot import Plot, missing, shown
from coim.experiments.frames import at, rows_of
from coim.experiments.statistics.intervals import CONFIDENCE, RESAMPLES, interval, iqm, mean
from coim.experiments.statistics.measures import COMPARED, MEASURES, NUMBERS, Cells, comparisons, limits, measures
from coim.experiments.statistics.predicted import predictions
from coim.experiments.statistics.retrained import with_retrained
from coim.experiments.study.arms import arm_named
from coim.experiments.study.runs import Place, Runs, read_runs

LABELS = {"area": "area: mean best return\nof a design", "final": "final: highest\nbest return"}
ENTROPY = "Q also holds the entropy bonus of Eq. 3, the return does not."
PREDICTION = "The prediction is the return that a posterior expected where one chose the bodies, and Eq. 5 elsewhere."
OF_SEARCH = ("search_gain", "rank_correlation", "rank_correlation_raw", "coverage", "bias_optimised", "bias_random")
INTERVALS = f"Intervals are {CONFIDENCE:.0%} percentile bootstraps over runs ({RESAMPLES} resamples)."
AREA = "area: the mean over designs of the best return of a design. final: the highest best return of all designs."
ARMS_SHOWN = ["environment", "task", "arm", "planned", "over", "diverged"]
ARMS_SHOWN += ["area_iqm", "final_iqm", "search_gain", "rank_correlation"]
PAIRS_SHOWN = ["environment", "task", "measure", "arm", "against", "difference", "improvement"]
PAIRS_SHOWN += ["welch_p_holm", "paired_p_holm", "detectable"]


def plots(study: Path) -> Iterator[Plot]:
    """Arms, pairs of arms, predictions, runs."""
    runs = read_runs(study)
    measured = with_retrained(measures(runs), study)
    yield arms(runs, measured)
    yield pairs(runs, measured)
    yield predicted(runs)
    yield spent(runs, measured)


def arms(runs: Runs, measured: pd.DataFrame) -> Plot:
    """Area and final best return of every arm, with a table of all measures of an arm."""
    rows, places = [], []
    for place in runs.places:
        own = at(measured, place)
        if own["final"][own["over"]].notna().any():
            places.append(place)
            rows += [summary(runs, place, arm, at(own, place, arm)) for arm in runs.arms_at(place)]
    if not places:
        return missing("statistics_arms", "No run has tried all its designs yet.", runs.in_words(runs.arms))
    figure, grid = new_figure(0.4 + (2.4 + room_for_names(runs.arms)) * len(places), len(places), len(MEASURES))
    axes_of = iter(grid)
    for place in places:
        for name in MEASURES:
            draw_arms(next(axes_of), runs, place, name, measured)
    caption = (
        "Area under the best-return curve and final best return of every arm. Points: runs that have tried all their "
        "designs or diverged. Bars: interquartile mean (IQM) and its 95 % bootstrap interval over runs. Ticks: means."
    )
    notes = (
        AREA,
        INTERVALS,
        "search_gain: mean best return of designs that were searched for minus that of random designs, mean over runs.",
        "rank_correlation: Spearman's correlation of the prediction before a body was built and the best return on it, "
        "over the bodies after the first ones, with the order of building held fixed, because predictions and returns "
        "both rise while the networks learn; mean over runs. rank_correlation_raw: the order not held fixed. "
        f"{PREDICTION}",
        "coverage: share of these best returns within the 90% interval of what a posterior expected.",
        "bias_optimised, bias_random: prediction minus best return, both as reward per step, on designs that were "
        "searched for and on random designs. Eq. 5 counts as (1 - gamma) Q(xi), a return as return / steps: equal if "
        f"the reward is constant. {ENTROPY}",
        "search_gain, rank_correlation, coverage and the biases are over the designs that a run reached; columns that "
        "end in _runs count the runs that have a value.",
        "diverged_share: share of the runs that have begun. hours: wall-clock of the cell. hours and updates are means "
        "over runs.",
        runs.in_words(runs.arms, counted=True),
    )
    return Plot(
        name="statistics_arms",
        figure=figure,
        rows=rows,
        caption=caption,
        notes=notes,
        table=shown(rows, ARMS_SHOWN),
    )


def summary(runs: Runs, place: Place, arm: str, own: pd.DataFrame) -> Cells:
    """A row of the table of arms, from the measures of the arm's runs."""
    over = own[own["over"]]
    row: Cells = {"environment": place[0], "task": place[1], "arm": arm, "planned": runs.planned[*place, arm]}
    diverged = int(own["diverged"].sum())
    row |= {"over": len(over), "diverged": diverged, "diverged_share": diverged / len(own) if len(own) else np.nan}
    for name in MEASURES:
        values = over[name].to_numpy()
        row |= {f"{name}_mean": float(mean(values)) if len(over) else np.nan}
        row |= {f"{name}_iqm": float(iqm(values)) if len(over) else np.nan} | limits(f"{name}_iqm", iqm, values)
    for name in OF_SEARCH:
        values = over[name].dropna().to_numpy()
        row |= {name: float(mean(values)) if values.size else np.nan} | limits(name, mean, values)
        row |= {f"{name}_runs": values.size}
    for name in ("hours", "updates"):
        row[name] = float(mean(over[name].to_numpy())) if len(over) else np.nan
    return row


def draw_arms(axes: Axes, runs: Runs, place: Place, name: str, measured: pd.DataFrame) -> None:
    """One measure of every arm of one environment and task."""
    for x, arm in enumerate(runs.arms_at(place)):
        here = at(measured[measured["over"]], place, arm)
        values, colour = here[name].to_numpy(), arm_named(arm).colour
        if here.empty:
            continue
        spread = x + np.linspace(-0.22, 0.22, len(here) + 2)[1:-1]
        axes.scatter(spread, values, s=12, alpha=0.6, linewidth=0, **arm_named(arm).point)
        low, high = interval(iqm, values)
        axes.vlines(x, low, high, color=colour, linewidth=2.5)
        axes.hlines(iqm(values), x - 0.3, x + 0.3, color=colour, linewidth=2.5)
        axes.hlines(mean(values), x - 0.3, x - 0.18, color=BLACK, linewidth=1)
    name_arms(axes, runs.arms_at(place))
    axes.set(ylabel=LABELS[name], title=", ".join(place))


def name_arms(axes: Axes, arms: Sequence[str]) -> None:
    """Write names below the columns: side by side, slanted or upright, by their number."""
    turned: dict[str, Any] = {}
    if angle := angle_of_names(arms):
        turned = {"rotation": angle, "ha": "right", "rotation_mode": "anchor"}
    if angle == 90:
        turned["va"] = "center"
    axes.set_xticks(range(len(arms)), arms, **turned)


def angle_of_names(arms: Sequence[str]) -> int:
    """Degrees by which the names of these arms are turned."""
    return 0 if len(arms) <= 4 else 30 if len(arms) <= 7 else 90


def room_for_names(arms: Sequence[str]) -> float:
    """Inches that turned names take from the height of a panel; 0 for names side by side."""
    longest = max(map(len, arms), default=0) * 0.07  # inches of a letter
    return longest * math.sin(math.radians(angle_of_names(arms)))


def pairs(runs: Runs, measured: pd.DataFrame) -> Plot:
    """Probability of improvement of each arm over its baselines, with the tests as a table."""
    rows = rows_of(comparisons(runs, measured))
    if not rows:
        why = "No two arms that are compared, an arm and a baseline of it, have runs that are over."
        return missing("statistics_pairs", why, runs.in_words(runs.arms))
    labels = list(dict.fromkeys(map(label_of, rows)))[::-1]  # the first on top
    there = [name for name in COMPARED if any(row["measure"] == name for row in rows)]
    figure, grid = new_figure(0.9 + 0.26 * max(4, len(labels)), 1, len(there))
    for axes, name in zip(grid, there):
        for row in (row for row in rows if row["measure"] == name):
            arm, y = arm_named(str(row["arm"])), labels.index(label_of(row))
            axes.plot([row["improvement_low"], row["improvement_high"]], [y, y], linewidth=2, color=arm.colour)
            axes.plot(row["improvement"], y, **arm.point)
        axes.axvline(0.5, color=GREY, linestyle="--", linewidth=0.8, zorder=0)
        axes.set(xlim=(-0.03, 1.03), ylim=(-0.7, len(labels) - 0.3), xlabel="probability of improvement")
        axes.set(title=name, yticks=range(len(labels)), yticklabels=labels if name == there[0] else [])
        axes.tick_params(axis="y", labelsize=7)
    caption = (
        "Probability of improvement: that a run of one arm ends above a run of the other, ties counting half, by area, "
        "final best return and retrained best body. Points: estimates. Bars: 95 % bootstrap intervals over runs. "
        "Dashed: no difference."
    )
    notes = (
        AREA,
        "retrained: best return of the best body of a run, trained from scratch, of the runs whose body was.",
        f"{INTERVALS} A probability of 1 means that no run of the other arm was above one of this arm; few runs often "
        "show that by chance.",
        "all: the mean over the environments and tasks in which both arms have runs, each resampled by itself.",
        "difference: of the means of the two arms. welch_p: Welch's t-test, two-sided.",
        "detectable: the difference that Welch's test finds (p below 0.05, uncorrected) in 80% of studies with these "
        "spreads and numbers of runs.",
        "paired_difference, paired_p: over the runs that share their seed, by a paired t-test. With five pairs "
        "Wilcoxon's test cannot go below 0.0625.",
        "_holm: corrected by Holm over all tests of that kind by that measure in this table. The uncorrected values "
        "are in the CSV.",
        runs.in_words(runs.arms, counted=True),
    )
    return Plot(
        name="statistics_pairs",
        figure=figure,
        rows=rows,
        caption=caption,
        notes=notes,
        table=shown(rows, PAIRS_SHOWN),
    )


def label_of(row: Mapping[str, Any]) -> str:
    """What stands beside a pair of arms."""
    return "{arm} over {against}\n{environment}, {task}".format(**row)


def predicted(runs: Runs) -> Plot:
    """The prediction before a body was built against the best return on it, both as reward per step."""
    rows: list[Cells] = []
    places = [
        place for place in runs.places if any(len(predictions(run)) for arm in runs.arms for run in runs.of(place, arm))
    ]
    if not places:
        return missing("statistics_predictions", "No design has both a prediction and a best return yet.")
    lines, columns = (len(places) + 1) // 2, min(2, len(places))
    figure, grid = new_figure(0.6 + 3.0 * lines, lines, columns)
    for axes, place in zip(grid, places):
        for arm in runs.arms:
            head = {"environment": place[0], "task": place[1], "arm": arm}
            own = [
                head | {"seed": run.seed, "run": run.number} | {key: row[key] for key in PREDICTED}
                for run in runs.of(place, arm)
                for row in rows_of(predictions(run))
            ]
            x, y = ([row[key] for row in own] for key in PREDICTED[-2:])
            axes.scatter(x, y, s=12, alpha=0.6, linewidth=0, **arm_named(arm).point)
            rows += own
        axes.axline((0, 0), slope=1, color=GREY, linestyle="--", linewidth=0.8, zorder=0)
        axes.set(xlabel="prediction, reward per step", ylabel="best return / steps")
        axes.set(title=", ".join(place))
    for axes in grid[len(places) :]:
        axes.remove()
    put_legend(figure, point_entries({str(row["arm"]) for row in rows}))
    caption = (
        "What was predicted of a body before it was built, against the best return on it: a point for each design, "
        "both as a reward per step. Dashed: equal."
    )
    notes = (
        f"{PREDICTION} As reward per step these are expected return / steps and (1 - gamma) Q, which is equal to "
        "return / steps if the reward is constant.",
        "Q weighs the first 1 / (1 - gamma) steps and is that of the population's policy; the return is that of the "
        f"best individual policy. {ENTROPY}",
        runs.in_words(runs.arms),
    )
    return Plot(name="statistics_predictions", figure=figure, rows=rows, caption=caption, notes=notes)


PREDICTED = ("design", "kind", "predicted", "best_return", "predicted_per_step", "return_per_step")


def spent(runs: Runs, measured: pd.DataFrame) -> Plot:
    """Wall-clock and updates of every run; the CSV has all measures of a run."""
    if measured.empty:
        return missing("statistics_runs", "No run has begun.", runs.in_words(runs.arms))
    head = ["environment", "task", "arm", "seed", "run", "state", "designs", "planned"]
    rows = rows_of(measured[[*head, *NUMBERS]])
    places = [place for place in runs.places if len(at(measured, place))]
    figure, grid = new_figure(0.4 + (2.2 + room_for_names(runs.arms)) * len(places), len(places), 2)
    labels = {"hours": "wall-clock of the cell (h)", "updates": "updates (number)"}
    for axes, (place, name) in zip(grid, ((place, name) for place in places for name in labels)):
        for x, arm in enumerate(runs.arms_at(place)):
            values = at(measured, place, arm)[name].to_numpy()
            spread = x + np.linspace(-0.25, 0.25, len(values) + 2)[1:-1]
            axes.scatter(spread, values, s=14, alpha=0.7, linewidth=0, **arm_named(arm).point)
        name_arms(axes, runs.arms_at(place))
        axes.set(ylabel=labels[name], title=", ".join(place))
        axes.set_ylim(0, 1.1 * at(measured, place)[name].max())
    caption = (
        "Wall-clock and updates of every run, also of those under way. Points: runs. Updates are those of both "
        "learners and the ensemble together."
    )
    notes = (
        "Wall-clock is that of the run's cell, whatever else the machine did meanwhile.",
        "episode_seconds: the median over the run's episodes, with their updates and evaluation.",
        runs.in_words(runs.arms),
    )
    return Plot(name="statistics_runs", figure=figure, rows=rows, caption=caption, notes=notes)
