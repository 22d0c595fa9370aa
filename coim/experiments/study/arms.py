"""Order, names and colours of a study's arms: the same in every figure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from matplotlib.lines import Line2D

from coim.experiments.drawing.palette import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, VERMILION

# What is compared. All arms of a seed share the first designs, the initial weights and the reset noise.
ARMS: dict[str, dict[str, Any]] = {
    "none": {"designs": "none"},  # the model-free baseline
    "known": {"designs": "known"},
    "noisy": {"designs": "noisy"},
    "random": {"designs": "random"},
    # No co-adaptation, and no search in it: both against "none".
    "control-only": {"designs": "none", "bodies": "fixed"},
    "random-bodies": {"designs": "none", "bodies": "random"},
    # Against "random": the same impossible pairs of state and body, without the error of a model.
    "oracle": {"designs": "random", "dream": "simulator"},
}

# Against whom: everybody against the baseline; what imagines unseen bodies against what imagines seen ones; the
# simulator that imagines random bodies against the model that does.
BASELINES = {"none": None, "known": ("noisy", "random"), "random": ("oracle",)}

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


def pairs_of_arms(arms: Sequence[str]) -> list[tuple[str, str]]:
    """Who is compared with whom, by `BASELINES`."""
    return [
        (arm, against)
        for against, whom in BASELINES.items()
        for arm in arms
        if against in arms and arm != against and (whom is None or arm in whom)
    ]
