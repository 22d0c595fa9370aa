"""One self-contained HTML page made of sections: nothing to fetch and nothing to execute.

``page.html`` beside this file is the template. It escapes every value.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib.figure import Figure

from coim.experiments.drawing.layout import FONT, lay_out

PIXELS = 96  # of an inch
RESOLUTION = 200  # of what is drawn as pixels inside of a figure, per inch
MOST_COLUMNS = 10  # of a table


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table whose first column names its rows.

    Attributes:
        head: names of the columns.
        rows: cells, the name of the row first.
        marked: names of rows that are set off from the others.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    marked: frozenset[str] = frozenset()


@dataclass(frozen=True, kw_only=True)
class Section:
    """A section of the page.

    Attributes:
        title: its heading.
        figure: None where there is nothing to draw; a note then says why.
        caption: what is drawn, in at most 60 words.
        alt: the same in numbers, for readers who cannot see the figure.
        notes: sentences in small print.
        tables: any number of tables, at most ten columns each; see `narrow`.
        folded: whether a reader unfolds it first.
        film: an mp4 in base64, or empty.
    """

    title: str
    figure: Figure | None = None
    caption: str = ""
    alt: str = ""
    notes: Sequence[str] = ()
    tables: Sequence[Table] = ()
    folded: bool = False
    film: str = ""


class Svg(NamedTuple):
    """A figure as the page holds it, with its size in pixels."""

    base64: str
    width: int
    height: int


def page(title: str, sections: Sequence[Section]) -> str:
    """The whole page."""
    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("page.html").render(title=title, sections=sections, svg=svg)


def svg(figure: Figure) -> Svg:
    """A figure drawn as SVG; its text is outlines, so that every browser shows the same."""
    drawn = io.BytesIO()
    with mpl.rc_context(FONT):
        lay_out(figure).savefig(drawn, format="svg", dpi=RESOLUTION, metadata={"Date": None})
    width, height = (round(inches * PIXELS) for inches in figure.get_size_inches())
    return Svg(base64.b64encode(drawn.getvalue()).decode(), width, height)


def narrow(table: Table) -> Iterator[Table]:
    """A table that fits on the page, or several with the same rows where it has too many columns.

    Example:
        >>> wide = Table(head=["", *"abcdefghijk"], rows=[["row", *"0123456789X"]])
        >>> [(len(table.head), table.rows[0][:2]) for table in narrow(wide)]
        [(10, ['row', '0']), (3, ['row', '9'])]
    """
    for start in range(1, len(table.head), MOST_COLUMNS - 1):
        own = slice(start, start + MOST_COLUMNS - 1)
        rows = [[name, *cells[own.start - 1 : own.stop - 1]] for name, *cells in table.rows]
        yield Table(head=[table.head[0], *table.head[own]], rows=rows, marked=table.marked)
