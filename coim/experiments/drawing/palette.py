"""Colours, shapes and legends of all pictures.

Okabe and Ito's palette: its contrasts survive the common kinds of colour blindness. Shapes and dashes tell things apart
too, on paper without colours.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

BLACK, GREY, LIGHT = "#000000", "#999999", "#E0E0E0"
BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"

KINDS = {"first": (BLUE, "o"), "optimised": (VERMILION, "^"), "random": (GREEN, "s"), "fixed": (ORANGE, "D")}
Dashes = (
    str | tuple[float, tuple[float, ...]]
)  # matplotlib's line style; a tuple is an offset, then line and gap lengths
DASHES: tuple[Dashes, ...] = ("-", "--", "-.", ":", (0, (3, 1, 1, 1, 1, 1)), (0, (8, 2)), (0, (6, 1, 1, 1)))
CHARACTERS = 120  # that fit side by side in a legend over the page's width
CIRCLE = {"markersize": 9, "markerfacecolor": "none", "markeredgecolor": "magenta", "markeredgewidth": 2}  # as Fig. 4
COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)


def style_of(index: int, count: int) -> dict[str, Any]:
    """Matplotlib's keywords for lines of one of several things that are compared; black for a single one."""
    if count == 1:
        return {"color": BLACK, "linestyle": "-"}
    return {"color": COLOURS[index % len(COLOURS)], "linestyle": DASHES[index // len(COLOURS) % len(DASHES)]}


def literal(name: str) -> str:
    """A folder's name as matplotlib draws it as it is: no formula between dollars, no underscore that hides it."""
    return (" " if name.startswith("_") else "") + name.replace("$", r"\$")


def kind_handles(kinds: Iterable[str], colour: str | None = None) -> list[Line2D]:
    """Entries of a legend for kinds of design; ``colour`` overrules the kind's own."""
    there = set(kinds)
    return [
        Line2D([], [], color=colour or own, marker=marker, linestyle="", label=f"{kind} design")
        for kind, (own, marker) in KINDS.items()
        if kind in there
    ]


def put_legend(figure: Figure, handles: list[Line2D]) -> None:
    """A legend above a figure, in as many columns as its words leave room for."""
    if handles:
        longest = max(len(str(handle.get_label())) for handle in handles)
        columns = max(1, min(len(handles), CHARACTERS // (longest + 8)))
        figure.legend(handles=handles, loc="outside upper center", ncols=columns, frameon=False)
