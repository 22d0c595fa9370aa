"""``python -m benchmarks``: one table of ratios, each measured side by side in one run, and the same as JSON."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal, get_args

import torch
import tyro

from benchmarks import table
from benchmarks.bodies import bodies
from benchmarks.compiling import compiling
from benchmarks.effort import FULL, QUICK, Effort
from benchmarks.iteration import iteration
from benchmarks.libraries import libraries, products
from benchmarks.measure import Figure
from benchmarks.memory import memory
from benchmarks.model import ensemble, imagination
from benchmarks.rivals import sb3, sbx
from benchmarks.search import search
from benchmarks.updates import together, torchrl, update
from coim.experiments.run.atomic_write import dated_file
from coim.experiments.run.interrupt import on_command_line
from coim.experiments.run.machine import available_cores, prepare

Row = Literal[
    "products",
    "libraries",
    "update",
    "together",
    "torchrl",
    "sb3",
    "sbx",
    "ensemble",
    "imagination",
    "search",
    "bodies",
    "iteration",
    "memory",
    "compiling",
]
ROWS: dict[Row, Callable[[Effort], list[Figure]]] = {
    "products": products,
    "libraries": libraries,
    "update": update,
    "together": together,
    "torchrl": torchrl,
    "sb3": sb3,
    "sbx": sbx,
    "ensemble": ensemble,
    "imagination": imagination,
    "search": search,
    "bodies": bodies,
    "iteration": iteration,
    "memory": memory,
    "compiling": compiling,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """What to measure."""

    only: tuple[Row, ...] = get_args(Row)
    """These rows alone, measured in this order."""
    quick: bool = False
    """Fewer repeats and smaller sizes: a first look, not a result."""
    out: Path | None = None
    """JSON file; by default runs/benchmarks-DATE.json for the whole table, and none for a part or a quick look."""


def main(options: Options) -> None:
    """Measure, print the table, write the file."""
    prepare(available_cores(), torch.device("cpu"))
    found = table.machine()
    measured: dict[str, list[Figure]] = {}
    for name in options.only:
        start = time.perf_counter()
        measured[name] = ROWS[name](QUICK if options.quick else FULL)
        print(f"{name}: {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    figures = [figure for name in ROWS for figure in measured.get(name, [])]
    print(table.heading(found))
    if options.quick:
        print("a quick look: sizes are smaller than those that the targets are meant for")
    print(table.text(figures))
    whole = set(options.only) == set(ROWS) and not options.quick
    out = dated_file("benchmarks", ".json") if whole and options.out is None else options.out
    if out is not None:
        table.write(out, found, figures)
        print(f"written to {out}", file=sys.stderr)


if __name__ == "__main__":
    with on_command_line(own_process=True):
        main(tyro.cli(Options, prog="python -m benchmarks", description=__doc__))
