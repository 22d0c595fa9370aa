"""Fig. 2: returns of the best designs of each arm, retrained from scratch, and tests between arms."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from coim.experiments.drawing.layout import new_figure
from coim.experiments.drawing.palette import GREY
from coim.experiments.figures.plot import Cells, Plot, missing, shown
from coim.experiments.frames import at, read_frame, rows_of
from coim.experiments.statistics.intervals import RESAMPLES
from coim.experiments.statistics.retrained import by_place, pairs, results, sizes
from coim.experiments.study.arms import arm_named
from coim.experiments.study.runs import CHOSEN, Runs, read_runs

DESIGNS, TESTS = "figure_2_retrained", "figure_2_tests"
TESTS_SHOWN = ["environment", "task", "arm", "against", "designs", "runs"]
TESTS_SHOWN += ["difference", "welch_designs_p", "welch_runs_p", "welch_runs_p_holm"]


def plots(study: Path) -> Iterator[Plot]:
    """The designs and the tests between arms, from what ``coim retrain`` wrote."""
    path, command = study / "retrained" / CHOSEN.file, f"coim retrain {study}"
    if not path.is_file():
        yield from nothing(f"No design was retrained: {command}.")
        return
    listed = read_frame(path, CHOSEN)
    rows, lost = results(path.parent, listed)
    if rows.empty:
        diverged = f"; {lost} diverged before their first return" if lost else ""
        yield from nothing(f"None of {len(listed)} designs is retrained yet: {command}{diverged}.")
        return
    yield draw_designs(rows, [*rules(rows, listed, lost), *early(read_runs(study), listed), *origins(rows)])
    yield draw_tests(pairs(rows))


def nothing(words: str) -> Iterator[Plot]:
    """Both plots without a figure."""
    yield missing(DESIGNS, words)
    yield missing(TESTS, words)


def rules(rows: pd.DataFrame, listed: pd.DataFrame, lost: int) -> list[str]:
    """Notes on which designs were retrained, how long, and what a diverged training counts."""
    episodes, in_study = (
        " or ".join(str(count) for count in sorted({*rows[name]})) for name in ("episodes", "study_episodes")
    )
    diverged, replaced = rows["diverged"].sum(), rows["replaced"].sum()
    counted = f"{len(rows) + lost} of {len(listed)} designs are retrained, {diverged + lost} of them diverged"
    if diverged > replaced:
        counted += "; these count with the best return until then"
    if replaced:
        counted += f"; {replaced} without a return until then: counts with the lowest best return of its place"
    if lost:
        counted += f"; {lost} left out, as no retraining of their environment and task has a return"
    return [
        f"Training takes {episodes} episodes of plain SAC from scratch, with a seed of its own for each design.",
        f"Designs are the best of {among(listed)} in each run, by their return in the study after {in_study} episodes. "
        + ("" if is_of_all(listed) else "First and random designs are left out, even where they were better. ")
        + "A body that comes again counts again.",
        f"{counted}.",
    ]


def is_of_all(listed: pd.DataFrame) -> bool:
    """Whether designs of all kinds were candidates."""
    return "all" in {*listed["of"]}


def among(listed: pd.DataFrame) -> str:
    """What the designs were chosen from, in words."""
    return "all that were built" if is_of_all(listed) else "those that the search found"


def early(runs: Runs, listed: pd.DataFrame) -> list[str]:
    """A note on arms whose designs were chosen before all runs were over that the study plans by now."""
    chosen = listed.drop_duplicates(["environment", "task", "arm"], keep="last")
    words = [
        f"{environment}, {task}, {arm}: {over:.0f} of {planned}"
        for environment, task, arm, over in zip(*(chosen[name] for name in ("environment", "task", "arm", "over")))
        if over < (planned := runs.planned[environment, task, arm])  # NaN, which older studies have, is not
    ]
    if not words:
        return []
    return [f"Chosen before all runs were over ({'; '.join(words)} planned now); designs of the others had no chance."]


def origins(rows: pd.DataFrame) -> list[str]:
    """A note for each environment and task on where the designs of each arm come from."""
    return [
        f"{', '.join(place)}: {'; '.join(origin(arm, designs) for arm, designs in own.items())}."
        + (" The shares differ, which favours the arm with the smaller one." if unequal(own) else "")
        for place, own in by_place(rows).items()
    ]


def origin(arm: str, designs: pd.DataFrame) -> str:
    """Where the designs of one arm come from."""
    counts, found, kept = sizes(designs), designs["found"].iloc[0], designs["kept"].iloc[0]
    words = f"{arm}: {counts['designs']} designs, distinct bodies {counts['bodies']}, runs {counts['runs']}"
    if math.isnan(found):
        return words
    return f"{words}, chosen as the best of each run, {kept:.0f} of {found:.0f} ({100 * kept / found:.0f} %)"


def unequal(own: dict[str, pd.DataFrame]) -> bool:
    """Whether no one share, rounded up to whole designs of each run, gives the number that was kept of each arm."""
    counts = pd.DataFrame([rows.iloc[0][["found", "kept"]] for rows in own.values()], dtype=float)
    counts["runs"] = [sizes(rows)["runs"] for rows in own.values()]
    least = (counts["kept"] / counts["found"]).min()
    return bool(((counts["kept"] - counts["runs"]) / counts["found"] >= least).any())


def draw_designs(rows: pd.DataFrame, notes: Sequence[str]) -> Plot:
    """A panel for each environment and task."""
    places = by_place(rows)
    widths = [max(2.6, 0.6 + 0.75 * len(own)) for own in places.values()]  # inches, with room for the names of arms
    figure = Figure(figsize=(max(3.6, sum(widths)), 3.4), layout="constrained")
    panels = figure.subplots(1, len(places), squeeze=False, width_ratios=widths)[0]
    for axes, (place, own) in zip(panels, places.items()):
        draw_boxes(axes, {arm: rows["best_return"].to_numpy() for arm, rows in own.items()})
        axes.set(title=", ".join(place), ylabel="best return, retrained from scratch")
    caption = (
        "Highest return on the best designs of each run, after training plain SAC on each of them from scratch. "
        "Points: designs. Boxes: quartiles and median. Whiskers: all designs."
    )
    return Plot(name=DESIGNS, figure=figure, rows=rows_of(rows), caption=caption, notes=notes)


def draw_boxes(axes: Axes, values: dict[str, np.ndarray]) -> None:
    """Boxes and points of each arm."""
    for x, (arm, returns) in enumerate(values.items()):
        colour = arm_named(arm).colour
        axes.boxplot(
            returns, positions=[x], widths=0.5, whis=(0, 100), patch_artist=True,
            boxprops={"facecolor": colour, "alpha": 0.25, "edgecolor": colour},
            medianprops={"color": colour, "linewidth": 1.6}, whiskerprops={"color": colour}, capprops={"color": colour},
        )  # fmt: skip
        spread = x + np.linspace(-0.18, 0.18, len(returns) + 2)[1:-1]
        axes.scatter(spread, returns, s=14, zorder=3, **arm_named(arm).point)
    axes.set(xticks=range(len(values)), xticklabels=[f"{arm}\nn = {len(v)}" for arm, v in values.items()])
    axes.spines[["top", "right"]].set_visible(False)


def draw_tests(table: pd.DataFrame) -> Plot:
    """Differences with their intervals, a line for each pair and a panel for each environment and task."""
    if table.empty:
        return missing(TESTS, "No two arms that are compared have retrained designs.")
    places = table[["environment", "task"]].drop_duplicates().itertuples(index=False, name=None)
    own = {place: rows_of(at(table, place)) for place in places}
    figure, grid = new_figure(sum(0.8 + 0.3 * len(rows) for rows in own.values()), len(own))
    for axes, (place, rows) in zip(grid, own.items()):
        draw_differences(axes, rows)
        axes.set(title=", ".join(place))
    grid[-1].set(xlabel="difference of the mean best return, retrained from scratch")
    caption = (
        "Fig. 2 in numbers: difference of the mean best returns of two arms over their retrained designs. Bars: 95 % "
        "bootstrap intervals over runs. Dashed: no difference."
    )
    notes = (
        f"The bootstrap draws runs, all designs of a run together ({RESAMPLES} resamples). An arm with less than two "
        "runs has no interval.",
        "designs, bodies, runs: retrained designs of the arm, distinct bodies among them, and runs of the study that "
        "they come from. _against: the same of the other arm.",
        "welch_designs_p: Welch's t-test over designs, two-sided, as in the paper. welch_runs_p: the same test over "
        "one mean for each run. _holm: corrected by Holm over all tests of that kind in this table.",
        "Designs of one run are not independent, as the test over designs takes them to be. In simulated studies "
        "without a difference, of five runs with five designs, welch_designs_p is below 0.05 in 23 %, welch_runs_p in "
        "5 %, and the interval leaves out 0 in 13 %.",
    )
    rows = rows_of(table)
    return Plot(name=TESTS, figure=figure, rows=rows, caption=caption, notes=notes, table=shown(rows, TESTS_SHOWN))


def draw_differences(axes: Axes, rows: Sequence[Cells]) -> None:
    """One environment and task; the first pair on top."""
    for y, row in enumerate(reversed(rows)):
        arm = arm_named(str(row["arm"]))
        difference, low, high = (float(str(row[f"difference{end}"])) for end in ("", "_low", "_high"))
        axes.plot([low, high], [y, y], linewidth=2, color=arm.colour)
        axes.plot(difference, y, **arm.point)
    axes.axvline(0, color=GREY, linestyle="--", linewidth=0.8, zorder=0)
    labels = ["{arm} minus {against}".format(**row) for row in reversed(rows)]
    axes.set(ylim=(-0.7, len(rows) - 0.3), yticks=range(len(rows)), yticklabels=labels)
