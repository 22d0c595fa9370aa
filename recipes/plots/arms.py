"""Order, names and colours of a study's arms: the same in every figure."""

from __future__ import annotations

from collections.abc import Iterable

from matplotlib.lines import Line2D

from recipes.reporting.palette import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, VERMILION

# The paper's colours as far as this palette has them: none blue, known red, noisy yellow, random black.
STYLES = {
    "none": {"color": BLUE, "linestyle": "-"},
    "known": {"color": VERMILION, "linestyle": "--"},
    "noisy": {"color": ORANGE, "linestyle": "-."},
    "random": {"color": BLACK, "linestyle": ":"},
    "control-only": {"color": GREY, "linestyle": "--"},
    "random-bodies": {"color": GREEN, "linestyle": "-."},
    "oracle": {"color": PURPLE, "linestyle": "-"},
}
MARKERS = {
    "none": "o",
    "known": "^",
    "noisy": "s",
    "random": "D",
    "control-only": "v",
    "random-bodies": "P",
    "oracle": "*",
}


def in_order(arms: Iterable[str]) -> list[str]:
    """Arms as figures list them; those that are not known here come last, by name."""
    known = list(STYLES)
    return sorted(set(arms), key=lambda arm: (known.index(arm) if arm in STYLES else len(known), arm))


def style(arm: str) -> dict[str, str]:
    """Colour and dashes of an arm."""
    return STYLES.get(arm, {"color": GREY, "linestyle": "-"})


def handles(arms: Iterable[str]) -> list[Line2D]:
    """Entries of a legend: lines."""
    return [Line2D([], [], label=arm, **style(arm)) for arm in in_order(arms)]
