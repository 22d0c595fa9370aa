"""Fig. 2: returns of the best designs that each arm found, retrained from scratch."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from recipes.plots import arms as styles
from recipes.plots.intervals import interval, mean
from recipes.plots.measures import pairs_of_arms, welch
from recipes.plots.plot import Plot, missing
from recipes.plots.runs import Run, runs_of_folder
from recipes.reporting.records import number

NAME = "figure_2_retrained"
Cells = dict[str, object]


def plots(study: Path) -> Iterator[Plot]:
    """One figure, from what `recipes.retrain` wrote."""
    path = study / "retrained" / "designs.csv"
    if not path.is_file():
        yield missing(NAME, f"No design was retrained: python -m recipes.retrain {study}.")
        return
    with path.open(newline="") as file:
        listed = list(csv.DictReader(file))
    rows = results(path.parent, listed)
    if not rows:
        yield missing(NAME, f"None of {len(listed)} designs is retrained yet: python -m recipes.retrain {study}.")
        return
    yield draw(rows, len(listed), early(listed))


def results(folder: Path, listed: Sequence[dict[str, str]]) -> list[Cells]:
    """A row for each design whose retraining is over.

    One that diverged counts with the best return that it had; if it had none, with the lowest of its place.
    """
    over: list[tuple[dict[str, str], Run]] = []
    for line in listed:
        found = runs_of_folder(
            folder / "cells" / line["folder"], line["environment"], line["task"], line["arm"], int(line["seed"])
        )
        over += [(line, run) for run in found if run.over]
    lowest: dict[tuple[str, str], float] = {}
    for line, run in over:
        place = line["environment"], line["task"]
        lowest[place] = min([lowest.get(place, math.inf), *(row["best_return"] for row in run.designs)])
    return [
        {name: line[name] for name in ("environment", "task", "arm", "seed", "run", "design", "xi")}
        | {"found_return": float(line["found_return"])}
        | {"best_return": float(run.best_returns(lowest[line["environment"], line["task"]]).max())}
        | {"diverged": int(run.diverged)}
        for line, run in over
    ]


def early(listed: Sequence[dict[str, str]]) -> str:
    """Whose designs were chosen before all runs of the arm were over, in words; those found later had no chance."""
    counts = {
        (line["environment"], line["task"], line["arm"]): (line["over"], line["planned"])
        for line in listed
        if line.get("over") != line.get("planned")
    }
    told = [f"{', '.join(which)}: {over} of {planned}" for which, (over, planned) in counts.items()]
    return f"Chosen before all runs were over ({'; '.join(told)}). " if told else ""


def draw(rows: Sequence[Cells], planned: int, early: str = "") -> Plot:
    """A panel for each environment and task."""
    places = list(dict.fromkeys((str(row["environment"]), str(row["task"])) for row in rows))
    figure = Figure(figsize=(max(3.6, 2.6 * len(places)), 3.4), layout="constrained")
    said = []
    for axes, place in zip(figure.subplots(1, len(places), squeeze=False)[0], places):
        own = [row for row in rows if (row["environment"], row["task"]) == place]
        values = {
            arm: np.array([row["best_return"] for row in own if row["arm"] == arm], dtype=float)
            for arm in styles.in_order(str(row["arm"]) for row in own)
        }
        draw_panel(axes, values)
        tests = [tested(values, arm, against) for arm, against in pairs_of_arms(list(values))]
        said += [f"{', '.join(place)}: {words}" for words in tests]
        axes.set(title=", ".join(place), ylabel="best return, retrained from scratch (1)")
    diverged = sum(bool(row["diverged"]) for row in rows)
    caption = (
        "Highest return of the deterministic policy of plain SAC, trained from scratch on the best designs of each arm "
        "(boxes: quartiles and median, whiskers: all designs; points: designs). "
        f"{len(rows)} of {planned} designs are retrained, {diverged} of them diverged"
        f"{' and count with the best return until then' if diverged else ''}. {early}{'; '.join(said)}"
        f"{'. ' if said else ''}The test takes designs for independent, as the paper does; those of one run are not."
    )
    return Plot(name=NAME, figure=figure, rows=rows, caption=caption)


def draw_panel(axes: Axes, values: dict[str, np.ndarray]) -> None:
    """Boxes and points of each arm."""
    for x, (arm, returns) in enumerate(values.items()):
        colour = styles.style(arm)["color"]
        axes.boxplot(
            returns, positions=[x], widths=0.5, whis=(0, 100), patch_artist=True,
            boxprops={"facecolor": colour, "alpha": 0.25, "edgecolor": colour},
            medianprops={"color": colour, "linewidth": 1.6}, whiskerprops={"color": colour}, capprops={"color": colour},
        )  # fmt: skip
        spread = x + np.linspace(-0.18, 0.18, len(returns) + 2)[1:-1]
        axes.scatter(spread, returns, s=14, color=colour, marker=styles.MARKERS.get(arm, "o"), zorder=3)
    axes.set(xticks=range(len(values)), xticklabels=[f"{arm}\n(n = {len(v)})" for arm, v in values.items()])
    axes.spines[["top", "right"]].set_visible(False)


def tested(values: dict[str, np.ndarray], arm: str, against: str) -> str:
    """Welch's t-test in words."""
    x, y = values[arm], values[against]
    low, high = interval(lambda x, y, axis: mean(x, axis) - mean(y, axis), x, y)
    difference, p = number(x.mean() - y.mean(), 3), welch(x, y)
    words = f"{arm} minus {against} {difference}"
    if math.isfinite(low):
        words += f" (95 % interval {number(float(low), 3)} to {number(float(high), 3)})"
    return words + (f", Welch's t-test p = {p:.2g}" if math.isfinite(p) else ", too few designs for a test")
