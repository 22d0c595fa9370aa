"""Row: what compiling costs a run at its start, for the first time and where an earlier process has compiled."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager

from benchmarks.effort import Effort
from benchmarks.fresh import in_fresh_process
from benchmarks.measure import Figure, Target, over
from benchmarks.parts import dynamics_learner, replay, sac_learner
from coim import sample_batches

FOLDER = "TORCHINDUCTOR_CACHE_DIR"
ROW = "first update of each learner of a run, {}"


def compiling(effort: Effort) -> list[Figure]:
    """The first update of individual, population and ensemble, in a process for each measurement."""
    cold, warm = [], []
    for _ in range(effort.long_repeats):
        with empty_folder():
            for seconds in (cold, warm):
                (figure,) = in_fresh_process(measure, effort, cores=1)
                seconds += figure.amounts
    rows = (
        ("nothing compiled yet", "a later process", cold, warm, 20),
        ("in a later process", "the first one", warm, cold, 3),
    )
    return [
        Figure(
            row=ROW.format(when),
            against=against,
            ratios=over(seconds, others),
            amounts=tuple(seconds),
            unit="s",
            target=Target(limit, of="amount"),
        )
        for when, against, seconds, others, limit in rows
    ]


def measure(effort: Effort) -> list[Figure]:
    """To be run in a process that has compiled nothing."""
    batches = sample_batches(replay(1), batch_size=effort.batch_size, num_batches=1)[:, :, 0]
    learners = [sac_learner(effort), sac_learner(effort), dynamics_learner(effort)]
    start = time.perf_counter()
    for learner in learners:
        learner.update(batches)
    return [Figure(row="first updates", against="", amounts=(time.perf_counter() - start,))]


@contextmanager
def empty_folder() -> Iterator[None]:
    """Let processes to come find nothing of what was compiled before."""
    before = os.environ.get(FOLDER)
    with tempfile.TemporaryDirectory() as folder:
        os.environ[FOLDER] = folder
        try:
            yield
        finally:
            del os.environ[FOLDER]
            if before is not None:
                os.environ[FOLDER] = before
