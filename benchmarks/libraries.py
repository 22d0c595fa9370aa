"""Rows: what each library makes of the products, and whether `coim.products.FASTEST` is right on this processor."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from statistics import median
from typing import get_args

import torch

from benchmarks.effort import Effort
from benchmarks.floors import Product, alone, flop
from benchmarks.measure import Figure, interleaved, over, taking, threads
from benchmarks.parts import model_products, replay, update_products
from benchmarks.updates import FLOOR, our_updates, plural, too_few_cores
from coim.experiments.run.machine import available_cores
from coim.learners.flat_weights import Precision
from coim.products import Choice, Library, fastest, kind_of_processor

MARGIN = 1.05  # of two medians; below it the difference may be the machine's mood
PRECISIONS: tuple[Precision, ...] = ("float32", "bfloat16")


def products(effort: Effort) -> list[Figure]:
    """The same products by each library: why a ratio to the floor can fall below 1."""
    found = []
    lists = {
        "an update": (update_products(effort), effort.updates),
        "an ensemble update": (model_products(effort), max(1, effort.updates // 4)),
    }
    for count in effort.threads:
        for name, (listed, times_over) in lists.items():
            row = f"products of {name}, {plural(count)}"
            if count > available_cores():
                found.append(Figure(row=row, against=FLOOR, note=too_few_cores(count)))
                continue
            with threads(count):
                found += _products(row, listed, times_over, effort.repeats)
    return found


def _products(row: str, listed: Sequence[Product], times_over: int, repeats: int) -> list[Figure]:
    actions = {"float32 by torch.mm": alone(listed, times=times_over)}
    for precision in PRECISIONS:
        for library, choice in possible(precision):
            action = alone(listed, times=times_over, by=choice, dtype=getattr(torch, precision))
            actions[words_of(precision, library)] = action
    times = interleaved(actions, repeats)
    work = flop(listed) * times_over / 1e9
    return [
        Figure(
            row=f"{row}, {name}",
            against=FLOOR,
            ratios=over(seconds, times["float32 by torch.mm"]),
            amounts=tuple(work / s for s in seconds),
            unit="GFLOP/s",
        )
        for name, seconds in times.items()
    ]


def libraries(effort: Effort) -> list[Figure]:
    """An update by each library, one thread, not native: what `FASTEST` chose should be the fastest."""
    buffer = replay(1)
    found = []
    for precision in PRECISIONS:
        choices = dict(possible(precision))
        ours = our_updates(buffer, effort, effort.updates, precision=precision, compile=False)
        floor = alone(update_products(effort), times=effort.updates)
        actions = {library: partial(under, choice, ours) for library, choice in choices.items()}
        times = interleaved({FLOOR: floor, **actions}, effort.repeats)
        ratios = {library: over(times[library], times[FLOOR]) for library in choices}
        chosen = getattr(fastest(), precision)
        found += [
            Figure(
                row=f"update, 1 thread, {words_of(precision, library)}",
                against=FLOOR,
                ratios=ratios[library],
                amounts=tuple(1e3 * seconds / effort.updates for seconds in times[library]),
                unit="ms",
                note=verdict(precision, chosen, ratios) if library == chosen else "",
            )
            for library in choices
        ]
    return found


def possible(precision: Precision) -> Iterator[tuple[Library, Choice]]:
    """Libraries that can multiply here in a precision; in the other one they are the fastest."""
    for library in get_args(Library):
        choice = fastest()._replace(**{precision: library})
        try:
            with taking(choice):
                pass
        except ValueError:
            continue
        yield library, choice


def under(choice: Choice, action: Callable[[], None]) -> None:
    """Act while these libraries multiply."""
    with taking(choice):
        action()


def verdict(precision: Precision, chosen: Library, ratios: dict[Library, Sequence[float]]) -> str:
    """Whether the table's choice is the fastest, and if not, what would be."""
    best = min(ratios, key=lambda library: median(ratios[library]))
    gain = median(ratios[chosen]) / median(ratios[best])
    if gain < MARGIN:
        return "chosen by the table"
    return (
        f"THE TABLE IS WRONG HERE: {best} is {gain:.2f} x as fast; mend FASTEST[{kind_of_processor()!r}] in "
        f"coim/products.py for {precision}"
    )


def words_of(precision: Precision, library: Library) -> str:
    """``float32 by torch``, ``bfloat16 emulated``."""
    return f"{precision} emulated" if library == "emulated" else f"{precision} by {library}"
