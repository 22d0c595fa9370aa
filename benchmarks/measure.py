"""Timing side by side, and what comes of it: ratios with their spread, and the target that they should reach."""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import torch

from coim.products import Choice, chosen, use

Times = dict[str, list[float]]


def interleaved(actions: Mapping[str, Callable[[], object]], repeats: int, *, warm_up: bool = True) -> Times:
    """Seconds of each action, repeat by repeat: whoever else wants the machine disturbs all of them alike.

    Args:
        actions: by name, in the order in which they take turns.
        repeats: of each.
        warm_up: run each once beforehand, unmeasured; not needed where a first call is lost in a long action.
    """
    for action in actions.values() if warm_up else ():
        action()
    times: Times = {name: [] for name in actions}
    for _ in range(repeats):
        for name, action in actions.items():
            start = time.perf_counter()
            action()
            times[name].append(time.perf_counter() - start)
    return times


def over(numerator: Sequence[float], denominator: Sequence[float]) -> tuple[float, ...]:
    """Ratios repeat by repeat."""
    return tuple(a / b for a, b in zip(numerator, denominator, strict=True))


@contextmanager
def taking(products: Choice) -> Iterator[None]:
    """Let these libraries multiply."""
    before = chosen()
    use(products)
    try:
        yield
    finally:
        use(before)


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Let torch use so many threads inside of an operation."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@dataclass(frozen=True)
class Target:
    """What a figure should reach.

    Attributes:
        limit: the worst value that reaches it.
        of: whether it is about the ratio or the amount.
        sense: whether the figure should stay at or below the limit, strictly below it, or at or above it.
    """

    limit: float
    of: Literal["ratio", "amount"] = "ratio"
    sense: Literal["<=", "<", ">="] = "<="

    def __str__(self) -> str:
        return f"{self.sense} {self.limit:,.5g}" + (" x" if self.of == "ratio" else "")

    def reached(self, value: float) -> bool:
        """Whether a value is good enough."""
        return {"<=": value <= self.limit, "<": value < self.limit, ">=": value >= self.limit}[self.sense]


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One line of the table.

    Attributes:
        row: what is measured.
        against: what it is divided by.
        ratios: one for each repeat; empty where nothing could be measured.
        amounts: the same as a quantity of its own, where there is one: updates, steps, gigabytes.
        unit: of the amounts.
        target: to be reached by the median; None where there is none.
        note: what else a reader wants to know, or why nothing could be measured.
        parts: seconds by part, medians.
    """

    row: str
    against: str
    ratios: tuple[float, ...] = ()
    amounts: tuple[float, ...] = ()
    unit: str = ""
    target: Target | None = None
    note: str = ""
    parts: dict[str, float] = dataclasses.field(default_factory=dict)

    @property
    def ratio(self) -> float:
        """Median of the ratios."""
        return statistics.median(self.ratios) if self.ratios else math.nan

    @property
    def amount(self) -> float:
        """Median of the amounts."""
        return statistics.median(self.amounts) if self.amounts else math.nan

    @property
    def met(self) -> bool | None:
        """Whether the median reaches the target; None without a target or a measurement."""
        value = self.ratio if self.target is None or self.target.of == "ratio" else self.amount
        return None if self.target is None or math.isnan(value) else self.target.reached(value)

    def as_json(self) -> dict[str, Any]:
        """Everything, as JSON can hold it."""

        def summary(values: Sequence[float]) -> dict[str, float] | None:
            if not values:
                return None
            middle, low, high = (round(f(values), 6) for f in (statistics.median, min, max))
            return {"median": middle, "min": low, "max": high}

        return {
            "row": self.row,
            "against": self.against,
            "ratio": summary(self.ratios),
            "amount": summary(self.amounts),
            "unit": self.unit,
            "repeats": len(self.ratios),
            "target": None if self.target is None else str(self.target),
            "met": self.met,
            "note": self.note,
            "seconds": {part: round(seconds, 6) for part, seconds in self.parts.items()},
        }
