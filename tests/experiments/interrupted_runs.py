"""Tiny runs, whole and cut short, for the tests of checkpoints and of what ends a run."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from coim import HopperMorph
from coim.experiments.run.checkpoint import Checkpoints
from coim.experiments.run.settings import Settings
from coim.experiments.study.definition import PROTOCOLS
from coim.experiments.train import main
from coim.experiments.train import run as run_recipe

TINY = dataclasses.replace(PROTOCOLS["smoke"], num_designs=4, first_episodes=2, episodes=2, threads=1, quiet=True)
SAVES = 4 + 4 * 2  # each chosen design and each episode


class PowerCut(BaseException):
    """Ends a run where it stands."""


def no_picture(folder: Path, body: type) -> Path:
    """Stand in for what takes longest."""
    return folder


def run(folder: Path, **settings: object) -> Path:
    """Make a run in this process."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("coim.experiments.train.draw_run", no_picture)
        return run_recipe(HopperMorph, "hopper", Settings(**{**vars(TINY), "out": folder, **settings}))


def resume(folder: Path, *options: str) -> None:
    """Go on with a run in this process, by the command line."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("coim.experiments.train.draw_run", no_picture)
        main(HopperMorph, "hopper", ["--resume", str(folder), *options])


@contextmanager
def power_cut(after: int) -> Iterator[None]:
    """End what is done here at the checkpoint behind so many."""
    left, save = after, Checkpoints.save

    def saved_or_cut(checkpoints: Checkpoints, notes: dict) -> None:
        nonlocal left
        if left == 0:
            raise PowerCut
        left -= 1
        save(checkpoints, notes)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Checkpoints, "save", saved_or_cut)
        with pytest.raises(PowerCut):
            yield


def cut(folder: Path, after: int, **settings: object) -> Path:
    """Make a run whose process ended after so many checkpoints."""
    with power_cut(after):
        run(folder, **settings)
    return folder
