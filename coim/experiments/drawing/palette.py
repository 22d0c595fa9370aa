"""Colours, shapes and legends of all pictures.

The palette is Okabe and Ito's; people with the common kinds of colour blindness can tell its colours apart. Marks and
dashes differ too, for paper without colours.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

BLACK, GREY, LIGHT = "#000000", "#999999", "#E0E0E0"
BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"

KINDS = {"first": (BLUE, "o"), "optimised": (VERMILION, "^"), "random": (GREEN, "s"), "fixed": (ORANGE, "D")}
# A line style of matplotlib; a tuple is an offset, then lengths of lines and gaps.
Dashes = str | tuple[float, tuple[float, ...]]
DASHES: tuple[Dashes, ...] = (
    "-",
    "--",
    "-.",
    ":",
    (0, (3, 1, 1, 1, 1, 1)),
    (0, (8, 2)),
    (0, (6, 1, 1, 1)),
    (0, (2, 3)),
    (0, (10, 3, 2, 3)),
)
CHARACTERS = 120  # that fit side by side in a legend over the page's width
# The circle of Fig. 4.
CIRCLE: dict[str, Any] = {
    "markersize": 9,
    "markerfacecolor": "none",
    "markeredgecolor": "magenta",
    "markeredgewidth": 2,
}
COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)


def style_of(index: int, count: int) -> dict[str, Any]:
    """Matplotlib's keywords for lines of one of several things that are compared; black for a single one."""
    if count == 1:
        return {"color": BLACK, "linestyle": "-"}
    return {"color": COLOURS[index % len(COLOURS)], "linestyle": DASHES[index // len(COLOURS) % len(DASHES)]}


def literal(name: str) -> str:
    """A folder's name that matplotlib draws literally: no formula between dollars, not hidden by an underscore."""
    return (" " if name.startswith("_") else "") + name.replace("$", r"\$")


def kind_handles(kinds: Iterable[str], colour: str | None = None) -> list[Line2D]:
    """Legend entries for kinds of design, in ``colour`` or each kind's own colour."""
    there = set(kinds)
    return [
        Line2D([], [], color=colour or own, marker=marker, linestyle="", label=f"{kind} design")
        for kind, (own, marker) in KINDS.items()
        if kind in there
    ]


def put_legend(figure: Figure, handles: Sequence[Artist]) -> None:
    """Put a legend above a figure, in as many columns as fit."""
    if handles:
        longest = max(len(str(handle.get_label())) for handle in handles)
        columns = max(1, min(len(handles), CHARACTERS // (longest + 8)))
        figure.legend(handles=handles, loc="outside upper center", ncols=columns, frameon=False)
