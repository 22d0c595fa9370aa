"""A process that has done nothing yet, for what depends on the process: its peak memory, the threads of its pools."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor

import torch

from benchmarks.effort import Effort
from benchmarks.measure import Figure, threads
from coim.experiments.run.machine import available_cores, prepare

Measurement = Callable[[Effort], list[Figure]]


def in_fresh_process(measurement: Measurement, effort: Effort, *, cores: int | None = None) -> list[Figure]:
    """Measure in a new process, on so many cores of this one's (None: all, with one thread)."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context, initializer=_confine, initargs=(cores,)) as pool:
        return pool.submit(_measure, measurement, effort, cores or 1).result()


def _confine(cores: int | None) -> None:
    """Leave only so many cores, before any library looks how many there are."""
    if cores is not None and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-cores:])


def _measure(measurement: Measurement, effort: Effort, count: int) -> list[Figure]:
    """Set the process up as real runs do, and measure."""
    prepare(available_cores(), torch.device("cpu"))
    with threads(count):
        return measurement(effort)
