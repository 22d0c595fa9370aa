"""Fig. 1 and Fig. 3: best return of each design over the order of building, every environment, task and arm."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from coim.experiments.drawing.curves import draw_mean
from coim.experiments.drawing.palette import GREY, put_legend
from coim.experiments.figures.legend import line_entries
from coim.experiments.figures.plot import Plot, missing
from coim.experiments.statistics.intervals import RESAMPLES, Statistic, iqm, mean, over_runs
from coim.experiments.study.arms import ARMS, FAMILIES, arm_named, in_order
from coim.experiments.study.runs import Place, Run, Runs, read_runs

PAPER = {
    "figure_1_best_returns": ["none", "known"],
    "figure_3_best_returns": ["none", "known", "noisy", "random"],
}
STATISTICS: dict[str, Statistic] = {"mean": mean, "IQM": iqm}
PANEL = (3.6, 2.3)  # inches
CAPTION = (
    "Best return of each design, in the order of building. Faint: single runs. Strong: their mean, or interquartile "
    "mean (IQM). Bands: pointwise 95 % bootstrap intervals over runs."
)
NOTES = (
    "The best return of a design is the highest undiscounted return of the deterministic policy over the evaluation "
    "episodes on it.",
    "The first designs are given. After them, designs that a search has chosen, by Eq. 5 unless the arm says "
    "otherwise, and random designs take turns.",
    "A mean is over the runs that have reached the design. Its interval is a percentile bootstrap within environment, "
    f"task and arm ({RESAMPLES} resamples).",
)


def plots(study: Path) -> Iterator[Plot]:
    """Fig. 1, Fig. 3, and a figure of each family of arms that has others."""
    runs = read_runs(study)
    for name, arms in (PAPER | families(runs.arms)).items():
        yield draw(name, runs, [arm for arm in arms if arm in runs.arms])


def families(there: Sequence[str]) -> dict[str, list[str]]:
    """Figures beside the paper's: each family with an arm that no other figure draws, with the family's baselines."""
    figures = {}
    for family in FAMILIES:
        own = [name for name in there if ARMS[name].family == family]
        elsewhere = {arm for arms in PAPER.values() for arm in arms}
        elsewhere |= {b for name in there if ARMS[name].family != family for b in ARMS[name].baselines}
        if {*own} - elsewhere:
            figures[f"best_returns_{family}"] = in_order([*own, *(b for name in own for b in ARMS[name].baselines)])
    return figures


def draw(name: str, runs: Runs, arms: list[str]) -> Plot:
    """One figure, a panel for each environment, task and statistic."""
    drawn = [arm for arm in arms if any(len(run.designs) for run in runs.found if run.arm == arm)]
    if not drawn:
        return missing(name, f"No run of {' or '.join(arms) or 'its arms'} has finished a design yet.")
    panels = arranged([place for place in runs.places if {*arms} & {*runs.arms_at(place)}])
    height = 0.4 + 0.2 * math.ceil(len(drawn) / 4) + PANEL[1] * len(panels)  # a line of the legend has room for four
    figure = Figure(figsize=(PANEL[0] * len(panels[0]), height), layout="constrained")
    grid = figure.subplots(len(panels), len(panels[0]), squeeze=False, sharex="col")
    rows: list[dict[str, object]] = []
    first: dict[Place, Axes] = {}  # panels of one place share their limits
    lowest: dict[int, Axes] = {}  # panel with lines of each column
    for i, (axes, (place, label)) in enumerate(zip(grid.flat, (panel for line in panels for panel in line))):
        if draw_panel(axes, runs, place, drawn, label, rows):
            lowest[i % len(panels[0])] = axes
        else:
            axes.axis("off")
            axes.text(0.5, 0.5, f"{', '.join(place)}:\nno design is finished yet", ha="center", va="center",
                      transform=axes.transAxes)  # fmt: skip
        axes.sharey(first.setdefault(place, axes))
    for axes in lowest.values():
        axes.tick_params(labelbottom=True)
        axes.set(xlabel="design (number)")
    entries = line_entries(drawn)
    if any(run.diverged for run in runs.found if run.arm in drawn):
        entries.append(Line2D([], [], marker="x", color=GREY, linestyle="", label="diverged after this design"))
    put_legend(figure, entries)
    return Plot(name=name, figure=figure, rows=rows, caption=CAPTION, notes=(*NOTES, runs.in_words(arms, counted=True)))


def arranged(places: Sequence[Place]) -> list[list[tuple[Place, str]]]:
    """Lines of panels: environments side by side, mean above IQM; for a single environment mean beside IQM."""
    environments, tasks = (list(dict.fromkeys(part)) for part in zip(*places))
    if len(environments) == 1:
        return [[((environments[0], task), label) for label in STATISTICS] for task in tasks]
    return [[((environment, task), label) for environment in environments] for task in tasks for label in STATISTICS]


def draw_panel(
    axes: Axes, runs: Runs, place: Place, arms: list[str], label: str, rows: list[dict[str, object]]
) -> bool:
    """Draw runs and one statistic of every arm, and add the numbers to ``rows``; returns whether there were any."""
    environment, task = place
    failure = runs.failure(place)
    for arm in arms:
        own = [run for run in runs.of(place, arm) if len(run.designs) or (run.diverged and math.isfinite(failure))]
        if not own:
            continue
        longest = max(run.num_designs for run in own)
        for run in own:
            draw_run(axes, run)
        values = best_returns(own, longest, failure)
        value, low, high, count = over_runs(values, STATISTICS[label])
        x, shown = np.arange(1, longest + 1), count > 0
        draw_mean(axes, x, value, low, high, **arm_named(arm).line)
        head: dict[str, object] = {"environment": environment, "task": task, "arm": arm, "series": label}
        for i in np.flatnonzero(shown):
            numbers = {"best_return": value[i], "low": low[i], "high": high[i], "runs": int(count[i])}
            rows.append(head | {"seed": "", "run": "", "design": int(x[i])} | numbers)
        if label == "mean":  # the single runs are the same in both panels
            rows += [row for run in own for row in rows_of(run)]
    if axes.lines:
        axes.set(title=f"{environment}, {task}", ylabel=f"best return of a design,\n{label}")
        axes.spines[["top", "right"]].set_visible(False)
        axes.locator_params(axis="x", integer=True)
    return bool(axes.lines)


def best_returns(own: Sequence[Run], longest: int, failure: float) -> np.ndarray:
    """Best returns of the runs of one arm, ``[R, M]``, NaN where they are still to come.

    What a diverged run counts on a design that it did not reach is left out as long as a run under way has not reached
    that design either: it would be all that the arm has there.
    """
    values = np.full((len(own), longest), math.nan)
    for line, run in zip(values, own):
        line[: run.num_designs] = run.best_returns(failure)
    under_way = [run.state == "under way" for run in own]
    awaited = np.isnan(values[under_way]).any(0)
    for line, run in zip(values, own):
        if run.diverged:
            line[awaited & (np.arange(longest) >= len(run.designs))] = math.nan
    return values


def draw_run(axes: Axes, run: Run) -> None:
    """A faint line through what the run reached, with a cross where it diverged."""
    if run.designs.empty:
        return
    x, y = (run.designs[name].to_numpy() for name in ("design", "best_return"))
    colour = arm_named(run.arm).colour
    axes.plot(x, y, color=colour, linewidth=0.6, alpha=0.25, zorder=1)
    if run.diverged:
        axes.plot(x[-1:], y[-1:], color=colour, marker="x", linestyle="", zorder=4)


def rows_of(run: Run) -> list[dict[str, object]]:
    """The line of a single run."""
    head: dict[str, object] = {"environment": run.environment, "task": run.task, "arm": run.arm, "series": "run"}
    head |= {"seed": run.seed, "run": run.number}
    last = {"low": "", "high": "", "runs": 1}
    return [
        head | {"design": design, "best_return": best} | last
        for design, best in run.designs[["design", "best_return"]].itertuples(index=False, name=None)
    ]
