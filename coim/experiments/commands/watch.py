"""A run's policies on its bodies, as films: ``coim watch runs/A --design best``.

No screen is needed. Each film shows the evaluation to which the design owes its best return, at the speed at which it
happened, and lies in ``videos/`` of the run's folder or where ``--out`` says. A run that is still going on can be
watched too, and so can a policy that ``coim export`` has written. ``coim watch --pretrained hopper`` films a robot that
comes with the package. ``--live`` shows the robot in a browser instead, where it walks until Ctrl-C.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import tyro

from coim.experiments.pretrained import names, policy_file
from coim.experiments.run.interrupt import on_command_line

PRETRAINED_SECONDS = 5.0  # of simulated time, which is filmed in seconds


@dataclasses.dataclass(frozen=True, kw_only=True)
class Watch:
    """Film the policy of a run on its bodies."""

    folder: tyro.conf.Positional[Path | None] = None
    """Folder of a run, or a policy that coim export has written."""
    pretrained: str | None = None
    """A trained robot that comes with the package, in place of a folder; a name that is none lists them."""
    design: str = "best"
    """best, top5 (the best five beside each other), all (a film of each), or the number of a design, from 1; several as
    in 1,5,9 stand beside each other. An exported policy takes best or a body by its factors, as in 1,1.2,0.8,1."""
    run: int | None = None
    """One of K runs; by default the one with the best return of what is asked for."""
    steps: int | None = None
    """Steps of the episode to show; by default all, and more than that go on beyond its end. --pretrained shows 5 s."""
    policy: Literal["best", "population"] = "best"
    """best: that of the design's best evaluation. population: the one that serves every design, as it is now; also in
    runs that have kept no other."""
    body: str | None = None
    """Class of the body as module:Class, if it is not one of ours."""
    out: Path | None = None
    """Folder for the films; by default videos/ in the run's folder, and the present one for an exported policy."""
    width: int = 640
    """Pixels of one body's picture, an even number."""
    height: int = 480
    """Likewise."""
    format: Literal["mp4", "webp"] = "mp4"
    """webp: an animated picture, which a README shows."""
    live: bool = False
    """Show the robot in a browser, by mjviser, in place of a film (pip install 'coim[live]')."""
    port: int = 8080
    """Port of --live on this machine; the next free one if it is taken."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    asked = tyro.cli(Watch, prog="coim watch", args=arguments)
    with on_command_line(own_process=arguments is None, also=(ImportError, RuntimeError)):
        source = source_of(asked)
        print(f"reading {source}", file=sys.stderr, flush=True)  # imports take seconds
        if asked.live:
            show(asked, source)
            return
        if asked.port != Watch.port:
            raise ValueError(f"--port is of --live, leave it out without: {asked.port}")
        from coim.experiments.drawing.film import film, film_policy

        how = {name: getattr(asked, name) for name in ("design", "steps", "body", "width", "height", "format")}
        if source.is_dir() or not source.suffix:
            for path in film(source, run=asked.run, policy=asked.policy, out=asked.out, **how):
                print(path, flush=True)
            return
        if asked.run is not None or asked.policy != "best":
            raise ValueError(f"{source} is one policy: leave out --run and --policy, which choose one of a run")
        seconds = PRETRAINED_SECONDS if asked.pretrained else None
        print(film_policy(source, seconds=seconds, out=asked.out or Path(), **how), flush=True)


def show(asked: Watch, source: Path) -> None:
    """Let the robot walk in a browser.

    Raises:
        ValueError: if something of a film is asked for.
    """
    from coim.experiments.drawing.live import live

    film = ("steps", "out", "width", "height", "format")
    if given := [f"--{name}" for name in film if getattr(asked, name) != getattr(Watch, name)]:
        raise ValueError(f"{', '.join(given)} is of a film: leave it out with --live")
    live(source, design=asked.design, run=asked.run, policy=asked.policy, body=asked.body, port=asked.port)


def source_of(asked: Watch) -> Path:
    """The folder or the file that is asked for.

    Raises:
        ValueError: if it is neither or both, or there is no such pretrained robot.
    """
    if (asked.folder is None) == (asked.pretrained is None):
        raise ValueError(f"name the folder of a run or --pretrained {' | '.join(names())}, one of the two")
    return policy_file(asked.pretrained) if asked.folder is None else asked.folder
