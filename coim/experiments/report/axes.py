"""Lines, marks and legends that the figures of a report share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from coim.experiments.drawing.curves import draw_mean, draw_runs
from coim.experiments.drawing.palette import BLACK, GREY, KINDS, LIGHT, kind_handles, literal, put_legend, style_of
from coim.experiments.frames import Curves, curves
from coim.experiments.run.records import Record

MANY_MARKS = 120
MOST_EPISODES = 500  # points of a curve; of more, neighbours are averaged


def plot_curves(axes: Axes, found: Curves, *, label: str = "", faint: bool = True, **style: Any) -> None:
    """Each run a faint line where there are several, their mean a strong one."""
    if not found.x.size:
        return
    if faint and len(found.y) > 1:
        draw_runs(axes, found.x, found.y, color=style["color"])
    draw_mean(axes, found.x, found.mean, label=label, **style)


def episodes_in_a_point(record: Record) -> int:
    """Number of episodes that are averaged into one point of a curve over training steps."""
    return max(1, math.ceil(record.episodes["env_steps"].nunique() / MOST_EPISODES))


def points_in_words(records: Sequence[Record]) -> list[str]:
    """A note on how many episodes a point averages, if more than one."""
    most = max(episodes_in_a_point(record) for record in records)
    return [f"A point is the mean of {'up to ' if len(records) > 1 else ''}{most} episodes."] if most > 1 else []


def plot_over_steps(
    axes: Axes, records: Sequence[Record], column: str, *, prefix: str = "", faint: bool = True, **style: Any
) -> bool:
    """Draw one column of the episodes of each folder over training steps; returns whether it has any number."""
    drawn = False
    for index, record in enumerate(records):
        found = curves(record.episodes, "env_steps", column).averaged(episodes_in_a_point(record))
        plot_curves(
            axes, found, label=prefix or literal(record.name), faint=faint, **(style_of(index, len(records)) | style)
        )
        drawn |= bool(found.x.size)
    axes.xaxis.set_major_formatter("{x:,.0f}")
    return drawn


def plot_over_designs(axes: Axes, records: Sequence[Record], column: str) -> None:
    """One column of the designs of each folder: faint lines of runs, a mean, a mark at each design for its kind.

    A hollow mark is a design that still has episodes to come.
    """
    for index, record in enumerate(records):
        style = style_of(index, len(records))
        found = curves(record.designs, "design", column)
        line = style | ({"color": GREY} if len(records) == 1 and len(found.y) == 1 else {})
        plot_curves(axes, found, label=literal(record.name), **line)
        finished = record.designs.groupby("design")["finished"].any()
        rows = record.designs.drop_duplicates("design", keep="last").set_index("design", drop=False).sort_index()
        means = pd.Series(found.mean, found.x).reindex(rows.index)
        rows = rows.assign(**{column: means, "finished": finished})
        mark_kinds(axes, rows, column, style["color"] if len(records) > 1 else None)
        mark_divergences(axes, record.designs[record.designs["diverged"] != ""], "design", column)
    axes.locator_params(axis="x", integer=True)


def mark_kinds(axes: Axes, rows: pd.DataFrame, column: str, colour: str | None = None, x: str = "design") -> None:
    """A mark at each design for its kind, in ``colour`` or in the kind's own colour."""
    for kind, (own, marker) in KINDS.items():
        for finished in (True, False):
            points = rows[(rows["kind"] == kind) & (rows["finished"] == finished)]
            if not points.empty:
                paint = colour or own
                fill = paint if finished else "white"
                size = 22 if len(rows) <= MANY_MARKS else 9
                axes.scatter(
                    points[x], points[column], s=size, facecolor=fill, edgecolor=paint, marker=marker, zorder=4
                )


def _under_way(record: Record) -> bool:
    """Whether there is a design that no run has finished."""
    return not record.designs.groupby("design")["finished"].any().all()


def mark_divergences(axes: Axes, rows: pd.DataFrame, x: str, y: str) -> None:
    """A cross where a run diverged."""
    axes.scatter(rows[x], rows[y], s=45, color=BLACK, marker="x", zorder=5)


def cross_handles(records: Sequence[Record]) -> list[Line2D]:
    """Entry of a legend for the crosses, if there are any."""
    there = any(len(record.diverged) for record in records)
    return [Line2D([], [], color=BLACK, marker="x", linestyle="", label="run diverged")] if there else []


def explain(
    figure: Figure,
    records: Sequence[Record],
    *,
    kinds: bool = False,
    mean: bool = True,
    more: Sequence[Artist] = (),
) -> None:
    """A legend above the figure: folders where there are several, kinds of design where they are marked, the mean."""
    several = len(records) > 1
    handles: list[Artist] = [
        Line2D([], [], label=literal(r.name), **style_of(i, len(records))) for i, r in enumerate(records) if several
    ]
    if kinds:
        there = [kind for record in records for kind in record.designs["kind"]]
        handles += kind_handles(there, GREY if several else None)
        if any(_under_way(record) for record in records):
            hollow: dict[str, Any] = {"markerfacecolor": "white", "markeredgecolor": GREY}
            handles.append(Line2D([], [], marker="o", linestyle="", label="not finished", **hollow))
    if mean and not several and records[0].num_runs > 1:
        handles.append(Line2D([], [], label=f"mean of {records[0].num_runs} runs", **style_of(0, 1)))
    put_legend(figure, [*handles, *more])


def mark_builds(axes: Axes, record: Record) -> None:
    """A light line at each step at which the next body was built."""
    for steps in record.episodes.groupby("design")["env_steps"].first().iloc[1:]:
        axes.axvline(steps, color=LIGHT, linewidth=0.6, zorder=0)
