"""A run's policies on its bodies, as films: ``coim watch runs/A --design best``.

No screen is needed. Each film shows the evaluation to which the design owes its best return, at the speed at which it
happened, and lies in ``videos/`` of the run's folder or where ``--out`` says. A run that is still going on can be
watched too.
"""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import tyro

from coim.experiments.run.interrupt import on_command_line

SCREENS = ("DISPLAY", "WAYLAND_DISPLAY")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Watch:
    """Film the policy of a run on its bodies."""

    folder: tyro.conf.Positional[Path]
    """Folder of a run."""
    design: str = "best"
    """best, top5 (the best five beside each other), all (a film of each), or the number of a design, from 1."""
    run: int | None = None
    """One of K runs; by default the one with the best return of what is asked for."""
    steps: int | None = None
    """Steps of the episode to show; by default all, and more than that go on beyond its end."""
    policy: Literal["best", "population"] = "best"
    """best: that of the design's best evaluation. population: the one that serves every design, as it is now; also in
    runs that have kept no other."""
    body: str | None = None
    """Class of the body as module:Class, if it is not one of ours."""
    out: Path | None = None
    """Folder for the films; by default videos/ in the run's folder."""
    width: int = 640
    """Pixels of one body's picture, an even number."""
    height: int = 480
    """Likewise."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    asked = tyro.cli(Watch, prog="coim watch", args=arguments)
    if sys.platform == "linux" and not any(os.environ.get(name) for name in SCREENS):
        os.environ.setdefault("MUJOCO_GL", "egl")  # mujoco asks for it once, when it is imported: so not above
    with on_command_line(own_process=arguments is None, also=(ImportError, RuntimeError)):
        print(f"reading {asked.folder}", file=sys.stderr, flush=True)  # imports take seconds
        from coim.experiments.drawing.film import film

        for path in film(**vars(asked)):
            print(path, flush=True)
