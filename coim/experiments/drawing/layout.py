"""Figures of one size and style."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
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
    figure = Figure(figsize=(WIDTH, height), layout=ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.06))
    grid = figure.subplots(rows, columns, squeeze=False, sharex=sharex).ravel().tolist()
    for axes in grid:
        axes.spines[["top", "right"]].set_visible(False)
    return figure, grid
