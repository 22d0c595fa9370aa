"""One cell of a study, in whatever process it is computed."""

from __future__ import annotations

import os
import platform
import traceback
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

from coim.envs import BODIES
from coim.experiments.frames import read_frame
from coim.experiments.run.interrupt import ANY_NAME
from coim.experiments.run.provenance import now
from coim.experiments.run.resume import to_go_on
from coim.experiments.run.settings import Settings
from coim.experiments.train import run
from coim.run_folder import EVALUATIONS

STARTED = "started"  # how a line of a log begins with which a try began


def compute(environment: str, settings: Settings, log: Path) -> None:
    """Make the run of a cell, or go on with it from its last checkpoint.

    Args:
        environment: name of the body.
        settings: of the run; ``out`` is its folder.
        log: what it says, and how it ended if not well, is written there.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a", buffering=1, errors=ANY_NAME) as words, redirect_stdout(words), redirect_stderr(words):
        print(f"{STARTED} {now()} on {platform.node()}, process {os.getpid()}")
        try:
            run(BODIES[environment], environment, to_go_on(settings))
        except BaseException:
            traceback.print_exc()
            raise
        print(f"finished {now()}")


def tries(log: Path) -> int:
    """How often a cell was begun or gone on with."""
    return sum(line.startswith(STARTED) for line in log.read_text().splitlines()) if log.exists() else 0


def episodes_done(folder: Path, num_runs: int) -> int:
    """Episodes of a cell that are in its table."""
    try:
        return max(0, (folder / EVALUATIONS.file).read_bytes().count(b"\n") - 1) // num_runs
    except OSError:
        return 0


def seconds_of(folder: Path) -> float:
    """What a run took, by its own clock: of all the processes that computed at it; 0 if its table is not there."""
    rows = read_frame(folder / EVALUATIONS.file, EVALUATIONS)  # a shared file system may show it later
    return max((seconds for seconds in rows["seconds"].tolist() if seconds > 0), default=0.0)  # NaN is not
