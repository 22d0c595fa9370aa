"""Sections of the page on how bodies were chosen: returns that were expected, and what the search was worth."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from coim.experiments.drawing.layout import new_figure
from coim.experiments.drawing.palette import BLACK, GREY, literal, style_of
from coim.experiments.frames import rows_of
from coim.experiments.predictions import (
    CONFIDENCE,
    LEVEL,
    Estimate,
    coverage,
    foretold,
    mean_of_runs,
    prediction_interval,
    worth_of_search,
)
from coim.experiments.report.axes import explain, mark_kinds
from coim.experiments.report.designs import describe_correlation
from coim.experiments.report.page import Section, Table, narrow
from coim.experiments.run.records import Record, number
from coim.experiments.run.resume import OF_NO_NUMBER

MOST_PANELS = 4  # runs of one folder whose bodies are drawn and listed one by one
RINGED: dict[str, Any] = {"s": 95, "facecolor": "none", "edgecolor": BLACK, "linewidth": 1.0, "zorder": 5}


def expectations(records: Sequence[Record]) -> Section | None:
    """Best returns against those that a posterior expected, with its interval; None where there was no posterior."""
    title = "Expected and achieved"
    if not any(record.settings.get("chosen_by", "value") != "value" for record in records):
        return None
    if all(foretold(record.designs).empty for record in records):
        note = "No body has both an expected return and a best return yet: three returns are needed to expect a fourth."
        return Section(title=title, notes=[note])
    notes = [
        f"{record.name}: {sentence}" if len(records) > 1 else sentence
        for record in records
        for sentence in _hits(record)
    ]
    if len(records) == 1:
        return _over_designs(title, records[0], notes)
    return _against_each_other(title, records, notes)


def worth(records: Sequence[Record]) -> Section:
    """Mean best return of optimised bodies minus that of random ones, run by run and over the runs of each folder."""
    title = "What the search was worth"
    rows: list[list[str]] = []
    found: list[tuple[str, Estimate]] = []
    notes: list[str] = []
    alike: dict[str, dict[int | None, list[float]]] = {}
    for record in records:
        prefix = f"{record.name}, " if len(records) > 1 else ""
        gains: list[Estimate] = []
        for run, designs in _compared(record):
            gains.append(worth_of_search(designs))
            found.append((f"{prefix}run {run}", gains[-1]))
            rows.append([found[-1][0], *_counts(designs), *_cells(gains[-1])])
        if len(gains) > 1:
            found.append((f"{prefix}mean of {len(gains)} runs", mean_of_runs([gain.value for gain in gains])))
            rows.append([found[-1][0], "", "", "", "", *_cells(found[-1][1])])
        if gains:  # a folder that was copied, or repeated, is no further seed
            own = alike.setdefault(_less_seed(record), {})
            own.setdefault(record.settings.get("seed"), [gain.value for gain in gains])
        width = _width(record, gains)
        notes.append(f"{record.name}: {width}" if prefix else width)
    if not found:
        return Section(title=title, notes=notes)
    for seeds in alike.values():
        if len(seeds) > 1:
            values = [value for own in seeds.values() for value in own]
            name = f"mean of {len(values)} runs in {len(seeds)} folders that differ in their seed alone"
            found.append((name, mean_of_runs(values)))
            rows.append([name, "", "", "", "", *_cells(found[-1][1])])
    if any(_places_differ(designs) for record in records for _, designs in _compared(record)):
        notes.append(
            "The random bodies were built later on the mean than the optimised ones, which come first in turn. "
            "Controllers learn meanwhile, and this counts for the random bodies."
        )
    notes.append(
        "An interval of one run is over its bodies: it says what others, chosen by the same run, could have given. "
        "What another seed would give only several runs can tell."
    )
    head = ["", "optimised bodies", "their mean", "random bodies", "their mean", "difference", "95 % interval"]
    caption = (
        "Mean best return of the bodies that the search chose minus that of the random bodies built in turn with them, "
        f"with a {100 * CONFIDENCE:.0f} % interval: of one run over its bodies (Welch), of several over runs (Student)."
    )
    told = "; ".join(f"{name}: {number(gain.value)}, {_ends(gain)}" for name, gain in found)
    return Section(
        title=title,
        figure=_drawn(found),
        caption=caption,
        alt=f"Optimised minus random bodies. {told}",
        notes=notes,
        tables=[*narrow(Table(head=head, rows=rows))],
    )


def _less_seed(record: Record) -> str:
    """The settings of a run, less its seed and what computes nothing."""
    left_out = {"seed", *OF_NO_NUMBER} - {"num_designs"}
    return json.dumps({name: value for name, value in record.settings.items() if name not in left_out}, sort_keys=True)


def _drawn(found: Sequence[tuple[str, Estimate]]) -> Figure:
    """A point with its interval for each name, one below the other."""
    figure, (axes,) = new_figure(0.9 + 0.24 * len(found))
    places = np.arange(len(found))
    for place, (_, gain) in zip(places, found):
        axes.plot([gain.low, gain.high], [place, place], color=GREY, linewidth=2, zorder=1)
    axes.scatter([gain.value for _, gain in found], places, color=BLACK, s=22, zorder=2)
    axes.axvline(0, color=GREY, linestyle="--", linewidth=0.8, zorder=0)
    axes.set_yticks(places, [literal(name) for name, _ in found])
    axes.set(ylim=(len(found) - 0.4, -0.6), xlabel="best return of optimised bodies minus that of random ones")
    return figure


def _over_designs(title: str, record: Record, notes: Sequence[str]) -> Section:
    """Each body of a folder in the order of building: interval, expected return and best return."""
    drawn = [(run, rows) for run, rows in foretold(record.designs).groupby("run")][:MOST_PANELS]
    figure, grid = new_figure(0.7 + 2.4 * len(drawn), len(drawn), 1, sharex=True)
    cells: list[list[str]] = []
    for axes, (run, rows) in zip(grid, drawn):
        low, high = prediction_interval(rows["expected"], rows["deviation"])
        axes.vlines(rows["design"], low, high, color=GREY, linewidth=2.5, alpha=0.6, zorder=1)
        axes.scatter(rows["design"], rows["expected"], color=GREY, marker="_", s=90, linewidth=1.8, zorder=2)
        mark_kinds(axes, rows, "best_return")
        outside = ~rows["best_return"].between(low, high)
        axes.scatter(rows["design"][outside], rows["best_return"][outside], **RINGED)
        axes.set(ylabel="best return", title=f"run {run}" if len(drawn) > 1 else "")
        axes.locator_params(axis="x", integer=True)
        prefix = f"run {run}, " if record.num_runs > 1 else ""
        cells += _listed(rows, low, high, prefix)
    grid[len(drawn) - 1].set(xlabel="design (number)")
    explain(figure, [record], kinds=True, mean=False, more=_handles())
    caption = (
        "Best return of each body, and what the posterior over earlier returns expected before it was built: mean and "
        f"{100 * LEVEL:.0f} % interval, noise of a run included."
    )
    if len(drawn) < record.num_runs:
        caption += f" The first {len(drawn)} of {record.num_runs} runs; the counts below are of all."
    head = ["", "kind", "expected", *_ends_of_level(), "best return", "within"]
    return Section(
        title=title,
        figure=figure,
        caption=caption,
        alt="Expected and best returns over designs. " + "; ".join(notes),
        notes=notes,
        tables=[*narrow(Table(head=head, rows=cells))],
    )


def _against_each_other(title: str, records: Sequence[Record], notes: Sequence[str]) -> Section:
    """Expected against best returns of several folders, with the line on which they are equal."""
    figure, (axes,) = new_figure(3.8)
    for index, record in enumerate(records):
        rows = foretold(record.designs)
        colour = style_of(index, len(records))["color"]
        axes.hlines(
            rows["best_return"], *prediction_interval(rows["expected"], rows["deviation"]), color=colour, alpha=0.25
        )
        mark_kinds(axes, rows, "best_return", colour, x="expected")
    _draw_equal(axes)
    axes.set(xlabel="expected return before the body was built", ylabel="best return")
    explain(figure, records, kinds=True, mean=False)
    caption = (
        "Best return of each body against what the posterior over earlier returns expected before it was built, with "
        f"its {100 * LEVEL:.0f} % interval. Dashed: both are equal."
    )
    alt = "Expected against best returns. " + "; ".join(notes)
    return Section(title=title, figure=figure, caption=caption, alt=alt, notes=notes)


def _hits(record: Record) -> Iterator[str]:
    """Sentences on how many intervals held and how well the expected returns rank bodies, as a study counts them."""
    rows = foretold(record.designs)
    rows = rows[rows["kind"] != "first"]  # given, and expected by three or four returns at most
    if rows.empty:
        yield "no return was expected: bodies were not chosen by returns, or fewer than three are known."
        return
    hits = coverage(rows)
    least, most = hits.by_chance
    yield (
        f"After the first bodies, {hits.inside} of {hits.total} best returns ({100 * hits.share:.0f} %) lie within "
        f"their {100 * LEVEL:.0f} % interval. Of intervals that are right, {least} to {most} would hold in "
        f"{100 * CONFIDENCE:.0f} % of cases."
    )
    yield f"Expected and best returns: {describe_correlation(rows, 'expected')}."


def _listed(rows: pd.DataFrame, low: np.ndarray, high: np.ndarray, prefix: str) -> Iterator[list[str]]:
    """A line of the table for each body."""
    for row, least, most in zip(rows_of(rows), low, high):
        within = "yes" if least <= row["best_return"] <= most else "no"
        numbers = [number(value) for value in (row["expected"], least, most, row["best_return"])]
        yield [f"{prefix}design {row['design']}", row["kind"], *numbers, within]


def _ends_of_level() -> list[str]:
    """Names of the ends of a prediction's interval."""
    return [f"{100 * (1 - LEVEL) / 2:.0f} %", f"{100 * (1 + LEVEL) / 2:.0f} %"]


def _handles() -> list[Line2D]:
    """Entries of a legend for expected returns, their intervals and those that did not hold."""
    ring = Line2D(
        [], [], color=BLACK, marker="o", markersize=9, markerfacecolor="none", linestyle="", label="outside of it"
    )
    bar = Line2D([], [], color=GREY, linewidth=2.5, alpha=0.6, label=f"{100 * LEVEL:.0f} % interval")
    dash = Line2D([], [], color=GREY, marker="_", markersize=9, markeredgewidth=1.8, linestyle="", label="expected")
    return [dash, bar, ring]


def _draw_equal(axes: Axes) -> None:
    """The line on which both coordinates are equal, over all that is drawn."""
    axes.autoscale(False)
    low = max(axes.get_xlim()[0], axes.get_ylim()[0])
    axes.axline((low, low), slope=1, color=GREY, linestyle="--", linewidth=0.8, zorder=0)


def _compared(record: Record) -> Iterator[tuple[int, pd.DataFrame]]:
    """Designs of each run that has optimised and random ones with a best return, a diverged run as far as it came."""
    there = record.designs["finished"] | (record.designs["diverged"] != "")
    for run, designs in record.designs[there & np.isfinite(record.designs["best_return"])].groupby("run"):
        if {"optimised", "random"} <= {*designs["kind"]}:
            yield run, designs


def _places_differ(designs: pd.DataFrame) -> bool:
    """Whether the optimised designs of a run have other places in the order of building than the random ones."""
    places = designs.groupby("kind")["design"].mean()
    return bool(places["optimised"] != places["random"])


def _counts(designs: pd.DataFrame) -> Iterator[str]:
    """Number and mean best return of the optimised, then of the random designs of a run."""
    for kind in ("optimised", "random"):
        values = designs["best_return"][designs["kind"] == kind]
        yield str(len(values))
        yield number(values.mean())


def _width(record: Record, gains: Sequence[Estimate]) -> str:
    """A sentence on how wide the intervals within one run are, or on why there are none."""
    if not gains and record.settings.get("bodies", "search") != "search":
        return "bodies were not searched: there is nothing to compare."
    if not gains:
        return "no run has both an optimised and a random body with a best return yet."
    halves = sorted((gain.high - gain.low) / 2 for gain in gains if math.isfinite(gain.low))
    if not halves:
        return "one body of a kind has no spread: there is no interval within a run yet."
    reach = " to ".join(dict.fromkeys(number(half, 3) for half in (halves[0], halves[-1])))
    return (
        f"the interval of one run reaches {reach} to each side: one run cannot tell a search that is worth less than "
        "that from chance."
    )


def _cells(estimate: Estimate) -> list[str]:
    return [number(estimate.value), _ends(estimate)]


def _ends(estimate: Estimate) -> str:
    """An interval in words."""
    return f"{number(estimate.low)} to {number(estimate.high)}" if math.isfinite(estimate.low) else "not known"
