"""Tiny runs that are cut short, for the tests of checkpoints and of what ends a run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from tiny_runs import run

from coim.experiments.run.checkpoint import Checkpoints

SAVES = 4 + 4 * 2  # each chosen design and each episode


class PowerCut(BaseException):
    """Ends a run where it stands."""


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
