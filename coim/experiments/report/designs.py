"""Sections of the page on the designs of a run, or of several runs that are compared: one function each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from coim.envs import MorphEnv
from coim.experiments.drawing.bodies import BODIES_IN_A_LINE, draw_lines_of_bodies
from coim.experiments.drawing.layout import new_figure
from coim.experiments.drawing.palette import GREY, literal, style_of
from coim.experiments.frames import designs_of, spearman_given
from coim.experiments.report.axes import cross_handles, explain, mark_kinds, plot_over_designs
from coim.experiments.report.page import Section
from coim.experiments.run.records import Record, number

CORRELATION = "Spearman's rank correlation with the order of building held fixed"
MOST_BODIES = 64  # of one run; of more the best are drawn
BODIES_COMPARED = 5


def best_returns(records: Sequence[Record]) -> Section:
    """Best return of each design, in the order in which they were built."""
    figure, (axes,) = new_figure(3.4)
    plot_over_designs(axes, records, "best_return")
    axes.set(xlabel="design (number)", ylabel="best return of a design")
    explain(figure, records, kinds=True, more=cross_handles(records))
    tops = [
        f"{r.name}: highest {number(_top(r)['best_return'])} at design {_top(r)['design']}"
        for r in records
        if len(r.best)
    ]
    caption = "Highest return of the deterministic policy on each body, in the order in which they were built."
    return Section(
        title="Best return of each design",
        figure=figure,
        caption=caption,
        alt="Best return over designs. " + "; ".join(tops),
    )


def designs_over_time(records: Sequence[Record], body: type[MorphEnv] | None) -> Section:
    """Each design dimension over the order of building."""
    names = records[0].design_names
    size = len(names)
    figure, grid = new_figure(0.6 + 1.7 * math.ceil(size / 2), math.ceil(size / 2), 2, sharex=True)
    for i, (name, axes) in enumerate(zip(names, grid)):
        spread = [replace(r, designs=r.designs.assign(entry=designs_of(r.designs)[:, i])) for r in records]
        plot_over_designs(axes, spread, "entry")
        axes.set_title(name, loc="left", fontsize=10)
        axes.set(ylabel="scale factor")
        if body is not None:
            low, high = (float(bound[i]) for bound in body.design_bounds())
            margin = 0.06 * (high - low)
            axes.set(ylim=(low - margin, high + margin))
            for bound in (low, high):
                axes.axhline(bound, color=GREY, linestyle="--", linewidth=0.8, zorder=0)
    for axes in grid[size:]:
        axes.remove()
    for axes in grid[max(0, size - 2) : size]:
        axes.set(xlabel="design (number)")
        axes.tick_params(labelbottom=True)
    explain(figure, records, kinds=True, more=cross_handles(records))
    bounds = ""
    if body is not None:
        lowest, highest = (bound.unique().tolist() for bound in body.design_bounds())
        alike = len(lowest) == len(highest) == 1
        bounds = f" Dashed: the bounds, {lowest[0]:.3g} and {highest[0]:.3g}." if alike else " Dashed: the bounds."
    caption = f"Scale factors of the body, 1 as drawn.{bounds}"
    alt = f"Scale factors over designs: {', '.join(names)}.{bounds}"
    return Section(title="Designs over time", figure=figure, caption=caption, alt=alt)


def bodies(records: Sequence[Record], body: type[MorphEnv] | None) -> Section:
    """The bodies of one run, or the best of each folder."""
    title = "Bodies"
    if body is None:
        note = f"{records[0].environment} is no environment of coim: its bodies are not drawn."
        return Section(title=title, notes=[note])
    shown: list[tuple[str, pd.DataFrame]] = []
    for record in records:
        if len(record.best):
            run = _top(record).name
            own = record.designs[(record.designs["run"] == run) & np.isfinite(record.designs["best_return"])]
            ranked = own.sort_values("best_return", kind="stable")
            best = ranked.tail(MOST_BODIES if len(records) == 1 else BODIES_COMPARED)
            shown.append((f"{literal(record.name)}, run {run}", best.sort_values("design")))
    if not shown:
        return Section(title=title, notes=["No design has a return yet."])
    caption = (
        "Bodies at rest, to one scale, in the order in which they were built; below each its number and best return."
    )
    if len(records) > 1:
        caption += f" The best {BODIES_COMPARED} of the best run of each folder."
    else:
        rows = shown[0][1]
        shown = [("", rows[i : i + BODIES_IN_A_LINE]) for i in range(0, len(rows), BODIES_IN_A_LINE)]
        caption += f" The best {MOST_BODIES}" if len(rows) == MOST_BODIES else " All"
        caption += (
            f" of run {rows['run'].iloc[0]}, which has the best of all." if records[0].num_runs > 1 else " of the run."
        )
    numbers = ", ".join(
        f"design {design}: {number(best)}"
        for _, rows in shown
        for design, best in zip(rows["design"], rows["best_return"])
    )
    alt = f"Bodies with their best returns. {numbers}"
    return Section(title=title, figure=draw_lines_of_bodies(shown, body), caption=caption, alt=alt)


def predictions(records: Sequence[Record]) -> Section:
    """Eq. 5 before a body was built against the best return on it."""
    title = "Predicted and achieved"
    figure, (axes,) = new_figure(3.6)
    found = []
    for index, record in enumerate(records):
        known = np.isfinite(record.designs[["best_return", "predicted"]].to_numpy()).all(1)
        rows = record.designs[record.designs["finished"] & known]
        colour = style_of(index, len(records))["color"] if len(records) > 1 else None
        mark_kinds(axes, rows, "best_return", colour, x="predicted")
        found.append((f"{record.name}: " if colour else "") + describe_correlation(rows))
    if not axes.collections:
        note = "No design has both a prediction and a return yet: the first is built without one."
        return Section(title=title, notes=[note])
    axes.set(xlabel=r"predicted value $Q(\xi)$ before the body was built, discounted", ylabel="best return")
    explain(figure, records, kinds=True, mean=False)
    caption = (
        "Eq. 5 before anything was learnt on a body, against the best return on it. The scales differ (discounted "
        "value of the population, return of an episode); the order counts."
    )
    return Section(
        title=title,
        figure=figure,
        caption=caption,
        alt="Predicted value against best return. " + "; ".join(found),
        notes=[f"{words}." for words in found],
    )


def describe_correlation(rows: pd.DataFrame, said: str = "predicted") -> str:
    """A sentence on the rank correlation of what was ``said`` and best return, as a mean over runs.

    As `coim.experiments.statistics.measures` has it: after the first bodies, which are given, and with the order of
    building held fixed, since what is said and what is earned both rise while the networks learn.
    """
    rows = rows[rows["kind"] != "first"]
    by_run = [own for _, own in rows.groupby("run")]
    found = (spearman_given(own[said], own["best_return"], given=own["design"]) for own in by_run)
    values = [value for value in found if math.isfinite(value)]
    if not values:
        return f"rank correlation not defined (n = {len(rows)} designs after the first ones, four are needed)"
    counts = "/".join(str(n) for n in sorted({len(own) for own in by_run}))
    if len(values) == 1:
        return f"{CORRELATION} {values[0]:.2f} (n = {counts} designs)"
    spread = f"from {min(values):.2f} to {max(values):.2f}"
    return f"{CORRELATION} {np.mean(values):.2f}, mean of {len(values)} runs, {spread} (n = {counts} each)"


def _top(record: Record) -> pd.Series:
    """The best design of all runs; its name is the number of its run."""
    return record.best.iloc[int(record.best["best_return"].argmax())]
