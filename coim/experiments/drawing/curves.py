"""Curves over runs: single runs faint, their mean strong, its interval as a band.

Shapes: R runs, X points.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

MANY_POINTS = 2000  # faint lines of more points than that are pixels, so that a page stays small


def draw_runs(axes: Axes, x: np.ndarray, runs: np.ndarray, *, color: str, **style: Any) -> None:
    """A faint line for each run, through the points at which it has a number.

    Args:
        axes: axes to draw on.
        x: the points, ``[X]``.
        runs: their values, ``[R, X]``, NaN where a run has none.
        color: color of the lines.
        style: more keywords of matplotlib.
    """
    alpha = max(0.15, min(0.4, 1.5 / max(1, len(runs))))
    faint: dict[str, Any] = {"linewidth": 0.6, "alpha": alpha, "zorder": 1} | style
    for run in runs:
        there = np.isfinite(run)
        axes.plot(x[there], run[there], color=color, rasterized=runs.size > MANY_POINTS, **faint)


def draw_mean(
    axes: Axes, x: np.ndarray, value: np.ndarray, low: np.ndarray | None = None, high: np.ndarray | None = None,
    *, color: str, linestyle: Any = "-", marker: str = "", **style: Any,
) -> None:  # fmt: skip
    """A strong line, and around it a band; bars in its place where the line is only marks.

    Args:
        axes: axes to draw on.
        x: the points, ``[X]``.
        value: mean or another statistic over runs, ``[X]``.
        low: lower end of its interval, ``[X]``; None for no band.
        high: upper end, ``[X]``.
        color: color of line and band.
        linestyle: style of line and band; "none" for marks.
        marker: at each point; a lone point has one anyway, as a line through it would not be seen.
        style: more keywords of matplotlib for the line.
    """
    lone = np.isfinite(value).sum() == 1
    strong: dict[str, Any] = {"linewidth": 1.6, "zorder": 3, "marker": marker or ("o" if lone else "")} | style
    axes.plot(x, value, color=color, linestyle=linestyle, **strong)
    if low is None or high is None:
        return
    if linestyle == "none":
        axes.vlines(x, low, high, color=color, linewidth=0.8, zorder=2)
        return
    axes.fill_between(x, low, high, color=color, alpha=0.1, linewidth=0, zorder=2)
    for end in (low, high):
        axes.plot(x, end, color=color, linestyle=linestyle, linewidth=0.5, zorder=2)
