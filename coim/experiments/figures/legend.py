"""Legend entries for arms."""

from __future__ import annotations

from collections.abc import Iterable

from matplotlib.lines import Line2D

from coim.experiments.study.arms import arm_named, in_order


def line_entries(arms: Iterable[str]) -> list[Line2D]:
    """A line for each of these arms."""
    return [Line2D([], [], label=name, **arm_named(name).line) for name in in_order(arms)]


def point_entries(arms: Iterable[str]) -> list[Line2D]:
    """A point for each of these arms."""
    return [Line2D([], [], label=name, linestyle="", **arm_named(name).point) for name in in_order(arms)]
