"""Figures of one size and style."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

WIDTH = 7.2  # inches: A4 within its margins


def new_figure(height: float, rows: int = 1, columns: int = 1, *, sharex: bool = False) -> tuple[Figure, list[Axes]]:
    """A figure of the page's width with axes that have no frame at the top and right."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.06)
    grid = figure.subplots(rows, columns, squeeze=False, sharex=sharex).ravel().tolist()
    for axes in grid:
        axes.spines[["top", "right"]].set_visible(False)
    return figure, grid
