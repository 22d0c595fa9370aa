"""A figure of a study together with the numbers and the words that belong to it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from coim.experiments.run.records import number

Cells = Mapping[str, object]


@dataclass(frozen=True, kw_only=True)
class Plot:
    """A figure, its caption and notes, and the numbers behind it.

    Attributes:
        name: name of its files, without a suffix.
        figure: None where there is nothing to draw yet; the caption then says what is missing.
        rows: the numbers that are drawn, all with the same keys: the CSV file.
        caption: what is drawn, and over what its intervals are, in at most 60 words.
        notes: method, caveats and the state of the runs, a paragraph each.
        table: a table for the page, with at most ten columns; empty for none.
    """

    name: str
    figure: Figure | None
    rows: Sequence[Cells]
    caption: str
    notes: Sequence[str] = ()
    table: Sequence[Cells] = ()


def missing(name: str, caption: str, *notes: str) -> Plot:
    """A plot without a figure, because its input does not exist; the caption says so."""
    return Plot(name=name, figure=None, rows=(), caption=caption, notes=notes)


def shown(rows: Sequence[Cells], columns: Sequence[str]) -> list[dict[str, object]]:
    """Some columns of a table, for the page; a number that has an interval, with its interval.

    Args:
        rows: cells; ``NAME_low`` and ``NAME_high`` are the interval of ``NAME``.
        columns: names of those that the page shows.

    Example:
        >>> shown([{"arm": "none", "area": 12.0, "area_low": 9.5, "area_high": 14.0, "hours": 3.0}], ["arm", "area"])
        [{'arm': 'none', 'area': '12 (9.5 to 14)'}]
    """
    return [{name: with_interval(row, name) for name in columns} for row in rows]


def with_interval(row: Cells, name: str) -> object:
    """A cell, with its interval in words if the row has one."""
    value, low, high = (row.get(f"{name}{end}", math.nan) for end in ("", "_low", "_high"))
    if isinstance(value, float) and isinstance(low, float) and isinstance(high, float) and math.isfinite(low):
        return f"{number(value, 3)} ({number(low, 3)} to {number(high, 3)})"
    return value
