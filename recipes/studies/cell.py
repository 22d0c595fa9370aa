"""One cell of a study, in whatever process it is computed."""

from __future__ import annotations

import csv
import dataclasses
import os
import traceback
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

from recipes.experiment import run
from recipes.interrupt import LOCK
from recipes.results import now
from recipes.settings import Settings, refuse_changes, saved_settings
from recipes.studies.definition import BODIES

STARTED = "started"  # how a line of a log begins with which a try began


def compute(environment: str, settings: Settings, log: Path) -> None:
    """Make the run of a cell, or go on with it from its last checkpoint.

    Args:
        environment: name of the body.
        settings: of the run; ``out`` is its folder.
        log: what it says, and how it ended if not well, is written there.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a", buffering=1) as words, redirect_stdout(words), redirect_stderr(words):
        print(f"{STARTED} {now()} on {os.uname().nodename}, process {os.getpid()}")
        try:
            run(BODIES[environment], environment, to_go_on(settings))
        except BaseException:
            traceback.print_exc()
            raise
        print(f"finished {now()}")


def to_go_on(settings: Settings) -> Settings:
    """The settings with which a cell is begun, or with which its run is resumed.

    Raises:
        ValueError: if it was begun with settings on which its past depends and which are others now.
    """
    folder = settings.out
    if folder is None:
        raise ValueError("a cell has a folder")
    if not (folder / "config.json").exists():
        for path in folder.glob("*") if folder.exists() else []:
            if path.name != LOCK:  # what a process that was killed at once had not finished
                path.unlink()
        return settings
    saved = saved_settings(folder)
    resumed = dataclasses.replace(settings, out=saved.out, resume=folder)  # a study's folder may have been moved
    refuse_changes(saved, resumed)
    return resumed


def tries(log: Path) -> int:
    """How often a cell was begun or gone on with."""
    return sum(line.startswith(STARTED) for line in log.read_text().splitlines()) if log.exists() else 0


def episodes_done(folder: Path, num_runs: int) -> int:
    """Episodes of a cell that are in its table."""
    try:
        return max(0, (folder / "evaluations.csv").read_bytes().count(b"\n") - 1) // num_runs
    except OSError:
        return 0


def seconds_of(folder: Path) -> float:
    """What a run took, by its own clock: of all the processes that computed at it."""
    with (folder / "evaluations.csv").open(newline="") as file:
        return max((float(row["seconds"]) for row in csv.DictReader(file)), default=0.0)
