"""The summary of a study: every measure of every arm with its interval and the runs behind it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from coim.experiments.drawing.layout import new_axes, sheet
from coim.experiments.drawing.palette import GREY
from coim.experiments.figures.comparisons import INTERVALS
from coim.experiments.figures.plot import Cells, Plot, missing, with_interval
from coim.experiments.frames import at, rows_of
from coim.experiments.predictions import LEVEL
from coim.experiments.run.records import number
from coim.experiments.statistics.measures import measures
from coim.experiments.statistics.retrained import with_retrained
from coim.experiments.statistics.summary import SUMMARISED, named, summary
from coim.experiments.study.arms import arm_named
from coim.experiments.study.runs import Place, Runs, read_runs

TITLES = {
    "search_gain": "searched minus random bodies\n(mean best return)",
    "area": "best return of a body\n(mean over bodies)",
    "final": "best return\nof the best body",
    "rank_correlation": "predicted and achieved\n(rank correlation, -1 to 1)",
    "coverage": f"best returns within their\n{LEVEL:.0%} interval (share, 0 to 1)",
    "retrained": "best body trained anew\nfrom scratch (best return)",
}
MARKS = {"search_gain": 0.0, "rank_correlation": 0.0, "coverage": LEVEL}  # dashed lines
IN_A_LINE = 3
PANEL, LETTER, GAP = 1.8, 0.062, 0.05  # inches: a panel's axes, a small letter, and the least between two names
SMALL = 7.5  # points
CAPTION = (
    "Every measure of every arm. Points: runs. Bars: mean over runs, with its number above, and its 95 % bootstrap "
    "interval. Dashed: no gain, no correlation, and the share that is aimed at."
)
NOTES = (
    "search_gain: mean best return of the bodies that were searched for minus that of random ones. area: mean best "
    "return of a design. final: highest best return of all designs.",
    "rank_correlation: Spearman's, of the prediction before a body was built and the best return on it, over the "
    "bodies after the first ones, with the order of building held fixed. The prediction is the return that a posterior "
    "expected where one chose the bodies, and Eq. 5 in all other runs.",
    f"coverage: share of these best returns within the {LEVEL:.0%} interval of what the posterior expected. The "
    "interval is of a return, so it holds how much returns of one body vary, not only how uncertain their mean is.",
    "retrained: best return of the best body of a run when it is trained from scratch; of the best among those that "
    "coim retrain has chosen.",
    f"{INTERVALS} A measure that no run of an arm has is left out.",
)


def plots(study: Path) -> Iterator[Plot]:
    """One figure and ``summary.csv``."""
    runs = read_runs(study)
    measured = with_retrained(measures(runs), study)
    rows = summary(runs, measured)
    if rows.empty:
        yield missing("summary", "No run has tried all its designs yet.", runs.in_words(runs.arms))
        return
    yield draw(runs, measured[measured["over"]], rows)


def draw(runs: Runs, over: pd.DataFrame, rows: pd.DataFrame) -> Plot:
    """A part for each environment, with a panel for each measure that any of its runs has."""
    upright = not fit_side_by_side(rows["arm"].unique().tolist())
    longest = LETTER * max(map(len, rows["arm"])) * upright
    panels = {
        place: names
        for place in runs.places
        if (names := [name for name in SUMMARISED if len(of_measure(rows, place, name))])
    }
    lines = [math.ceil(len(names) / IN_A_LINE) for names in panels.values()]
    figure = sheet((2.0 + longest) * sum(lines) + 0.25 * len(panels))
    parts = figure.subfigures(len(panels), 1, squeeze=False, height_ratios=lines).ravel()
    for part, count, (place, names) in zip(parts, lines, panels.items()):
        part.suptitle(", ".join(place), fontweight="bold")
        grid = new_axes(part, count, IN_A_LINE)
        for axes, name in zip(grid, names):
            draw_measure(axes, place, name, over, of_measure(rows, place, name), upright=upright)
        for axes in grid[len(names) :]:
            axes.remove()
    return Plot(
        name="summary",
        figure=figure,
        rows=rows_of(rows),
        caption=CAPTION,
        notes=(*NOTES, runs.in_words(runs.arms, counted=True)),
        table=table(rows),
    )


def of_measure(rows: pd.DataFrame, place: Place, name: str) -> pd.DataFrame:
    """The rows of one measure in one environment, by arm."""
    return rows[(rows["environment"] == named(place)) & (rows["measure"] == name)].set_index("arm")


def fit_side_by_side(arms: Sequence[str]) -> bool:
    """Whether the names of arms, in lines that end at their hyphens, stand below a panel without touching each other.

    Example:
        >>> fit_side_by_side(["none", "random-bodies", "grounded"]), fit_side_by_side(["none"] * 6)
        (True, False)
    """
    longest = max(len(word) for arm in arms for word in arm.split("-"))
    return longest * LETTER + GAP <= PANEL / (len(arms) + 0.2)  # the panel begins and ends beside the outer names


def draw_measure(axes: Axes, place: Place, name: str, over: pd.DataFrame, rows: pd.DataFrame, *, upright: bool) -> None:
    """One measure of the arms that have it: a point for each run, and the mean with its interval and its number."""
    for x, arm in enumerate(rows.index):
        values, look = at(over, place, arm)[name].dropna().to_numpy(), arm_named(arm)
        spread = x + np.linspace(-0.22, 0.22, len(values) + 2)[1:-1]
        axes.scatter(spread, values, s=12, alpha=0.6, linewidth=0, **look.point)
        axes.vlines(x, rows["low"][arm], rows["high"][arm], color=look.colour, linewidth=2.5)
        axes.hlines(rows["mean"][arm], x - 0.3, x + 0.3, color=look.colour, linewidth=2.5)
    if name in MARKS:
        axes.axhline(MARKS[name], color=GREY, linestyle="--", linewidth=0.8, zorder=0)
    names = [arm if upright else arm.replace("-", "-\n") for arm in rows.index]
    axes.set_xticks(range(len(rows)), names, fontsize=SMALL, rotation=90 * upright)
    axes.set(title=TITLES[name], xlim=(-0.6, len(rows) - 0.4))
    above = axes.secondary_xaxis("top")  # the title then stands over the numbers
    means = [number(mean, 2) for mean in rows["mean"]]
    above.set_xticks(range(len(rows)), means, fontsize=SMALL, fontweight="bold", rotation=90 * upright)
    above.tick_params(length=0)
    above.spines["top"].set_visible(False)


def table(rows: pd.DataFrame) -> list[Cells]:
    """A row for each environment and arm, a column for each measure that any of them has."""
    there = [name for name in SUMMARISED if (rows["measure"] == name).any()]
    found: list[Cells] = []
    for (environment, arm), own in rows.groupby(["environment", "arm"], sort=False):
        cells = {
            row["measure"]: with_interval({"m": row["mean"], "m_low": row["low"], "m_high": row["high"]}, "m")
            for row in rows_of(own)
        }
        found.append({"environment": environment, "arm": arm} | {name: cells.get(name, math.nan) for name in there})
    return found
