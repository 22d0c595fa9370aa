"""Arms of a study: what each computes, what it is compared with, and how figures show it.

An arm is one entry of `ARMS`. Study definitions, statistics and figures read everything from it, so a new arm is a new
entry here and nothing else.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from matplotlib.colors import is_color_like
from matplotlib.lines import Line2D

from coim.experiments.drawing.palette import (
    BLACK,
    BLUE,
    DASHES,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    Dashes,
)
from coim.experiments.run.settings import METHODS

Family = Literal["imagination", "bodies", "grounded", "returns"]
FAMILIES: dict[Family, str] = {
    "imagination": "arms that differ in what they imagine",
    "bodies": "arms that differ in how they choose the next body",
    "grounded": "arms that choose bodies as `grounded` does and differ in what they imagine",
    "returns": "arms that choose bodies as `returns` does and differ in what they imagine",
}


@dataclass(frozen=True, kw_only=True)
class Arm:
    """One arm of a study.

    Args:
        name: its name in study files, folders and figures: lower-case letters, digits and hyphens.
        words: what it does, as the end of a sentence that begins with its name.
        settings: settings of its runs that differ from the study's protocol.
        baselines: names of the arms that it is compared with.
        family: arms of one family and their baselines share a figure of best returns.
        colour: no other arm of the family has it, so a family has at most eight arms.
        marker: matplotlib's; no other arm has it in this colour.

    Raises:
        ValueError: if the name, the colour or the marker cannot be used.

    Example:
        >>> ARMS["noisy"].settings, ARMS["noisy"].baselines
        ({'imagine': 'noisy'}, ('none', 'known'))
    """

    name: str
    words: str
    settings: Mapping[str, Any]
    baselines: tuple[str, ...]
    family: Family
    colour: str
    marker: str

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", self.name):
            raise ValueError(f"arm {self.name!r} must be named by lower-case words with hyphens, such as random-bodies")
        if not is_color_like(self.colour):
            raise ValueError(f"colour of arm {self.name} is {self.colour!r}, no colour; take one of drawing/palette.py")
        if self.marker not in Line2D.markers or self.marker in ("", " ", "none", "None"):
            raise ValueError(f"marker of arm {self.name} is {self.marker!r}; take one of matplotlib's, such as 'o'")

    @property
    def dashes(self) -> Dashes:
        """Line style: solid without a baseline, else one that no arm in the figure of the family has."""
        if not self.baselines:
            return DASHES[0]
        family = [arm for arm in ARMS.values() if arm.family == self.family and arm.baselines]
        others = {name for arm in family for name in arm.baselines if ARMS[name].family != self.family}
        taken = [DASHES[0], *(ARMS[name].dashes for name in others)]
        free = [dashes for dashes in DASHES if dashes not in taken]
        return free[family.index(self) % len(free)]

    @property
    def line(self) -> dict[str, Any]:
        """Matplotlib's keywords for its lines."""
        return {"color": self.colour, "linestyle": self.dashes}

    @property
    def point(self) -> dict[str, Any]:
        """Matplotlib's keywords for its points."""
        return {"color": self.colour, "marker": self.marker}


def by_name(*arms: Arm) -> dict[str, Arm]:
    """Arms by their names, in the order of figures and tables.

    Raises:
        ValueError: if two arms cannot be told apart, or a baseline is no arm.
    """
    found = {arm.name: arm for arm in arms}
    if len(found) < len(arms):
        raise ValueError(f"of {', '.join(arm.name for arm in arms)} two have the same name; rename one")
    for arm in arms:
        if unknown := [name for name in arm.baselines if name not in found or name == arm.name]:
            raise ValueError(f"baselines of arm {arm.name} are no other arms: {', '.join(unknown)}; add them first")
    looks: dict[tuple[str, str], str] = {}
    for arm in arms:
        own = [(arm.family, arm.colour), (arm.marker, arm.colour)]
        own += [(other.family, arm.colour) for other in arms if arm.name in other.baselines]  # the figure has it too
        for look in own:
            if looks.setdefault(look, arm.name) != arm.name:
                raise ValueError(f"arms {looks[look]} and {arm.name} look alike ({' '.join(look)}); change one of them")
    return found


ANCHORED = {"imagined_states": "matched", "anchored": True}

# All arms of a seed share the first designs, the initial weights and the reset noise.
# The paper's colours as far as the palette has them: none blue, known red, noisy yellow, random black.
ARMS = by_name(
    Arm(
        name="none",
        words="imagines nothing: the model-free baseline",
        settings={"imagine": "none"},
        baselines=(),
        family="imagination",
        colour=BLUE,
        marker="o",
    ),
    Arm(
        name="known",
        words="imagines the designs tried so far",
        settings={"imagine": "known"},
        baselines=("none",),
        family="imagination",
        colour=VERMILION,
        marker="^",
    ),
    Arm(
        name="noisy",
        words="imagines the designs tried so far with noise added",
        settings={"imagine": "noisy"},
        baselines=("none", "known"),  # unseen designs against seen ones
        family="imagination",
        colour=ORANGE,
        marker="s",
    ),
    Arm(
        name="random",
        words="imagines uniformly random designs",
        settings={"imagine": "random"},
        baselines=("none", "known"),
        family="imagination",
        colour=BLACK,
        marker="D",
    ),
    Arm(
        name="oracle",
        words="imagines uniformly random designs, with the simulator in place of the model",
        settings={"imagine": "random", "dream": "simulator"},
        baselines=("none", "random"),  # the same impossible pairs of state and body, without the error of a model
        family="imagination",
        colour=PURPLE,
        marker="*",
    ),
    Arm(
        name="control-only",
        words="imagines nothing and keeps one body",
        settings={"imagine": "none", "bodies": "fixed"},
        baselines=("none",),
        family="bodies",
        colour=GREY,
        marker="v",
    ),
    Arm(
        name="random-bodies",
        words="imagines nothing and builds random bodies only",
        settings={"imagine": "none", "bodies": "random"},
        baselines=("none",),
        family="bodies",
        colour=GREEN,
        marker="P",
    ),
    Arm(
        name="matched",
        words="imagines nothing and asks Eq. 5 about start states that the body can be in",
        settings={"imagine": "none", "value_states": "matched"},
        baselines=("none", "random-bodies"),
        family="bodies",
        colour=ORANGE,
        marker="X",
    ),
    Arm(
        name="visited",
        words="imagines nothing and asks Eq. 5 about visited states, put under the body",
        settings={"imagine": "none", "value_states": "matched", "value_over": "visited"},
        baselines=("none", "random-bodies"),
        family="bodies",
        colour=PURPLE,
        marker="d",
    ),
    Arm(
        name="returns",
        words="imagines nothing and searches a Gaussian process over the returns earned: Bayesian optimisation",
        settings={"imagine": "none", "chosen_by": "returns"},
        baselines=("none", "random-bodies"),
        family="bodies",
        colour=VERMILION,
        marker="h",
    ),
    Arm(
        name="posterior",
        words="imagines nothing and searches the same process with Eq. 5 over visited states as its mean",
        settings={
            "imagine": "none",
            "chosen_by": "posterior",
            "value_states": "matched",
            "value_over": "visited",
        },
        baselines=("none", "random-bodies", "returns"),
        family="bodies",
        colour=SKY,
        marker="8",
    ),
    Arm(
        name="grounded",
        words="chooses as posterior does, at first near the best body and then further away",
        settings={"imagine": "none", **METHODS["grounded"]},
        baselines=("none", "random-bodies", "returns", "posterior"),
        family="bodies",
        colour=BLACK,
        marker="p",
    ),
    Arm(
        name="grounded-known",
        words="chooses bodies as grounded does and imagines the designs tried so far",
        settings={"imagine": "known", **METHODS["grounded"]},
        baselines=("grounded",),
        family="grounded",
        colour=VERMILION,
        marker="<",
    ),
    Arm(
        name="grounded-noisy",
        words="chooses bodies as grounded does and imagines the designs tried so far with noise added",
        settings={"imagine": "noisy", **METHODS["grounded"]},
        baselines=("grounded", "grounded-known"),
        family="grounded",
        colour=ORANGE,
        marker="8",
    ),
    Arm(
        name="grounded-random",
        words="chooses bodies as grounded does and imagines uniformly random designs",
        settings={"imagine": "random", **METHODS["grounded"]},
        baselines=("grounded", "grounded-known"),
        family="grounded",
        colour=GREEN,
        marker="D",
    ),
    Arm(
        name="grounded-noisy-anchored",
        words="as grounded-noisy, from states that the body can be in and anchored at real transitions",
        settings={"imagine": "noisy", **ANCHORED, **METHODS["grounded"]},
        baselines=("grounded", "grounded-noisy"),
        family="grounded",
        colour=PURPLE,
        marker=">",
    ),
    Arm(
        name="grounded-random-anchored",
        words="as grounded-random, from states that the body can be in and anchored at real transitions",
        settings={"imagine": "random", **ANCHORED, **METHODS["grounded"]},
        baselines=("grounded", "grounded-random"),
        family="grounded",
        colour=SKY,
        marker="H",
    ),
    Arm(
        name="grounded-governed",
        words="as grounded-random-anchored, as much as the model's measured error allows",
        settings={"imagine": "random", **ANCHORED, "governed": True, **METHODS["grounded"]},
        baselines=("grounded", "grounded-random-anchored"),
        family="grounded",
        colour=BLUE,
        marker="*",
    ),
    Arm(
        name="grounded-governed-both",
        words="as grounded-governed, in the batches of the individual networks too",
        settings={
            "imagine": "random",
            **ANCHORED,
            "governed": True,
            "individual_imagined_share": 0.2,
            **METHODS["grounded"],
        },
        baselines=("grounded", "grounded-governed"),
        family="grounded",
        colour=GREY,
        marker="o",
    ),
    Arm(
        name="returns-known",
        words="chooses bodies as returns does and imagines the designs tried so far",
        settings={"imagine": "known", **METHODS["returns"]},
        baselines=("returns",),
        family="returns",
        colour=BLUE,
        marker="<",
    ),
    Arm(
        name="returns-noisy",
        words="chooses bodies as returns does and imagines the designs tried so far with noise added",
        settings={"imagine": "noisy", **METHODS["returns"]},
        baselines=("returns", "returns-known"),
        family="returns",
        colour=ORANGE,
        marker=">",
    ),
)


def arm_named(name: str) -> Arm:
    """The arm of this name.

    Raises:
        ValueError: if there is none.
    """
    if name not in ARMS:
        raise ValueError(f"arm {name!r} is none of {', '.join(ARMS)}; add it to ARMS in {__name__}")
    return ARMS[name]


def in_order(names: Iterable[str]) -> list[str]:
    """Each of these arms once, in the order of `ARMS`.

    Raises:
        ValueError: if one of them is no arm.
    """
    order = list(ARMS)
    return sorted({arm_named(name).name for name in names}, key=order.index)


def pairs_of_arms(names: Sequence[str]) -> list[tuple[str, str]]:
    """Pairs of an arm and each of its baselines among these names; if none is there, of the baselines of those."""
    found = {name: _baselines_among(name, names) for name in names}
    return [(name, baseline) for baseline in ARMS for name in names if baseline in found[name]]


def _baselines_among(name: str, names: Sequence[str]) -> set[str]:
    baselines = ARMS[name].baselines
    here = {baseline for baseline in baselines if baseline in names}
    return here or {far for baseline in baselines for far in _baselines_among(baseline, names)}
