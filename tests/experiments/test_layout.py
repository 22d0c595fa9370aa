"""Figures are placed once, where Matplotlib would place them in each file."""

from __future__ import annotations

import io

from matplotlib.figure import Figure
from matplotlib.layout_engine import LayoutEngine

from coim.experiments.drawing.layout import lay_out, new_figure


def drawn() -> Figure:
    """A figure whose axes must make room for words."""
    figure, grid = new_figure(3.0, 1, 2)
    for axes in grid:
        axes.set(title="two\nlines", ylabel="a label\nof two lines", yticks=[0, 1], yticklabels=["a", "a long one"])
    return figure


def places(figure: Figure) -> list[list[float]]:
    return [[*axes.get_position().bounds] for axes in figure.axes]


def test_axes_are_where_they_would_be_and_stay_there_in_every_file() -> None:
    placed, left = drawn(), drawn()
    left.draw_without_rendering()
    unplaced = places(drawn())
    assert lay_out(placed) is placed
    assert places(placed) == places(left) != unplaced
    before = places(placed)
    for suffix, dpi in (("png", 150), ("pdf", 72), ("svg", 96)):
        placed.savefig(io.BytesIO(), format=suffix, dpi=dpi)
        assert places(placed) == before


def test_what_is_placed_is_not_placed_again() -> None:
    figure, count = drawn(), []

    class Counting(LayoutEngine):
        _adjust_compatible = _colorbar_gridspec = True

        def execute(self, fig: Figure) -> None:
            count.append(fig)

    figure.set_layout_engine(Counting())
    for _ in range(2):
        lay_out(figure)
        figure.savefig(io.BytesIO(), format="png")
    assert count == [figure]
