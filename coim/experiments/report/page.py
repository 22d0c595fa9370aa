"""One self-contained HTML page: headings, tables and figures, nothing to fetch and nothing to execute."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from html import escape

import matplotlib as mpl
from matplotlib.figure import Figure

FONT = {"font.size": 9, "axes.titlesize": 9, "legend.fontsize": 8.5, "svg.hashsalt": "coim"}
POINTS, PIXELS = 72, 96  # of an inch
RESOLUTION = 200  # of what is drawn as pixels inside of a figure, per inch

STYLE = """
body { font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; color: #111;
       background: #fff; max-width: 56rem; margin: 0 auto; padding: 1.5rem; }
h1 { font-size: 1.6rem; margin: 0 0 .5rem; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; border-bottom: 1px solid #ccc; break-after: avoid; }
figure { margin: 0; break-inside: avoid; }
figure img { display: block; width: 100%; height: auto; }
figcaption, .note { color: #444; font-size: .9rem; max-width: 46rem; }
.note { margin: .3rem 0; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .85rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; vertical-align: top; padding: .15rem .9rem .15rem 0; border-bottom: 1px solid #e0e0e0; }
td { overflow-wrap: anywhere; }
thead th { border-bottom: 2px solid #888; }
tr { break-inside: avoid; }
tr.differs { font-weight: 600; background: #fff3d6; }
tr.differs th::after { content: " (differs)"; font-weight: 400; }
section { break-inside: auto; }
@page { size: A4; margin: 14mm; }
@media print {
  body { font-size: 10pt; max-width: none; padding: 0; }
  h2 { margin: 1rem 0 .4rem; }
  figure img { width: 86%; }
  section.picture { break-inside: avoid; }
  .wide { overflow: visible; }
  tr.differs { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
}
"""


def page(title: str, body: Sequence[str]) -> str:
    """A whole page around its sections."""
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{escape(title)}</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>{STYLE}</style>\n</head>\n<body>\n<h1>{escape(title)}</h1>\n"
        + "\n".join(body)
        + "\n</body>\n</html>\n"
    )


def section(title: str, content: str, *, kind: str = "") -> str:
    """A part of the page under a heading; ``kind`` is its class."""
    return f'<section class="{kind}">\n<h2>{escape(title)}</h2>\n{content}\n</section>'


def note(sentence: str) -> str:
    """A sentence in small print."""
    return f'<p class="note">{escape(sentence)}</p>'


def image(figure: Figure, *, alt: str, caption: str) -> str:
    """A figure with its caption; drawn as SVG, whose text is outlines, so that every browser shows the same."""
    drawn = io.BytesIO()
    with mpl.rc_context(FONT):
        figure.savefig(drawn, format="svg", dpi=RESOLUTION, metadata={"Date": None})
    width, height = (round(inches * PIXELS) for inches in figure.get_size_inches())
    data = base64.b64encode(drawn.getvalue()).decode()
    size = f'width="{width}" height="{height}"'
    return (
        f'<figure>\n<img alt="{escape(alt)}" {size} src="data:image/svg+xml;base64,{data}">\n'
        f"<figcaption>{escape(caption)}</figcaption>\n</figure>"
    )


def table(head: Sequence[str], rows: Sequence[Sequence[str]], *, differing: bool = False) -> str:
    """A table whose first column names its rows.

    Args:
        head: of the columns.
        rows: their cells.
        differing: whether to mark the rows whose other cells are not all equal.
    """
    lines = []
    for name, *cells in rows:
        kind = ' class="differs"' if differing and len(set(cells)) > 1 else ""
        cells = [f"<td>{escape(cell)}</td>" for cell in cells]
        lines.append(f'<tr{kind}><th scope="row">{escape(name)}</th>{"".join(cells)}</tr>')
    top = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in head)
    return (
        f'<div class="wide"><table>\n<thead><tr>{top}</tr></thead>\n<tbody>\n'
        + "\n".join(lines)
        + "\n</tbody></table></div>"
    )
