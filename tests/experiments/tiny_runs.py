"""Tiny runs of a second: not compiled, and without the picture and the page of a run, which take longer than the run.

A test of what is drawn or written there says ``page=True``, or calls `draw_run` or `write_report` itself; a test of
compiled gradients takes settings with ``compile=True``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import pytest

from coim import HopperMorph
from coim.experiments.run.last_words import options
from coim.experiments.run.settings import Settings
from coim.experiments.study.definition import PROTOCOLS
from coim.experiments.train import main
from coim.experiments.train import run as run_recipe

TINY = dataclasses.replace(PROTOCOLS["smoke"], num_designs=4, first_episodes=2, episodes=2, threads=1, quiet=True)
# Options of the smallest run that has every kind of design, and those of them that have no effect beside some others.
OPTIONS = options(dataclasses.replace(PROTOCOLS["smoke"], num_designs=7))
IDLE_BESIDE = {
    **{word: {"--model-updates", "--model-cells"} for word in ("none", "simulator")},
    **{word: {"--num-particles", "--num-iterations"} for word in ("fixed", "gradient")},
}


@contextmanager
def without_page() -> Iterator[None]:
    """Leave out the picture and the page at the end of the runs that are made in this process within."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("coim.experiments.train.draw_run", lambda folder, body: folder)
        patched.setattr("coim.experiments.train.write_report", lambda folders, body: folders[0])
        yield


def tiny(*given: str) -> list[str]:
    """Options of a tiny run, without those that have no effect beside the given ones."""
    idle = set().union(*(IDLE_BESIDE.get(word, set()) for word in given))
    words, kept = [], True
    for word in OPTIONS:
        kept = word not in idle if word.startswith("--") else kept
        words += [word] * kept
    return [*words, *given]


def run(folder: Path, *, page: bool = False, **settings: object) -> Path:
    """Make a run from settings."""
    with nullcontext() if page else without_page():
        return run_recipe(HopperMorph, "hopper", Settings(**{**vars(TINY), "out": folder, **settings}))


def run_by_options(folder: Path, *given: str, page: bool = False) -> None:
    """Make a run by the command line."""
    with nullcontext() if page else without_page():
        main(HopperMorph, "hopper", tiny("--out", str(folder), *given))


def resume(folder: Path, *given: str, page: bool = False) -> None:
    """Go on with a run, by the command line."""
    with nullcontext() if page else without_page():
        main(HopperMorph, "hopper", ["--resume", str(folder), *given])
