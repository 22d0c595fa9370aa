"""A figure of a study together with the numbers that it shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True)
class Plot:
    """A figure, the rows behind it, and what is seen in it.

    Attributes:
        name: of its files, without a suffix.
        figure: None where there is nothing to draw yet; the caption then says what is missing.
        rows: what is drawn, all with the same keys: the CSV file.
        caption: what is seen, in a sentence or two; of how many runs, where some are still to come.
        readable: whether the rows are few enough to be read as a table too.
    """

    name: str
    figure: Figure | None
    rows: Sequence[Mapping[str, object]]
    caption: str
    readable: bool = False


def missing(name: str, caption: str) -> Plot:
    """Instead of a plot whose input is not there: a sentence that says so."""
    return Plot(name=name, figure=None, rows=(), caption=caption)
