"""Figures of one size and style."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.layout_engine import ConstrainedLayoutEngine

WIDTH = 7.2  # inches: A4 within its margins
FONT: dict[Any, Any] = {"font.size": 9, "axes.titlesize": 9, "legend.fontsize": 8.5, "svg.hashsalt": "coim"}
STEPS = "training steps of one run"  # label of an axis


def new_figure(height: float, rows: int = 1, columns: int = 1, *, sharex: bool = False) -> tuple[Figure, list[Axes]]:
    """A figure of the page's width, and its axes without a frame at the top and right, line by line.

    Args:
        height: height of the figure in inches.
        rows: lines of axes.
        columns: axes in a line.
        sharex: whether all axes have the same x.
    """
    figure = sheet(height)
    return figure, new_axes(figure, rows, columns, sharex=sharex)


def sheet(height: float) -> Figure:
    """A figure of the page's width without axes; its height is in inches."""
    return Figure(figsize=(WIDTH, height), layout=ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.06))


def lay_out(figure: Figure) -> Figure:
    """Place the axes of a finished figure for good, and return it.

    Matplotlib places them in every file anew, and draws all once more to do so, which is half of the time.
    """
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)
    return figure


def new_axes(figure: FigureBase, rows: int, columns: int, *, sharex: bool = False) -> list[Axes]:
    """Axes of a figure or of a part of it; see `new_figure`."""
    grid = figure.subplots(rows, columns, squeeze=False, sharex=sharex).ravel().tolist()
    for axes in grid:
        axes.spines[["top", "right"]].set_visible(False)
    return grid
