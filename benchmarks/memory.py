"""Row: memory of Replay_Pop at the end of the paper's protocol."""

from __future__ import annotations

import sys
from pathlib import Path

from benchmarks.effort import Effort
from benchmarks.fresh import in_fresh_process
from benchmarks.measure import Figure, Target
from benchmarks.parts import random_rows
from coim import TransitionBuffer, sample_batches

try:
    import resource
except ImportError:  # not a Unix
    resource = None  # type: ignore[assignment]

CHUNK = 100_000
GIGABYTE = 1e9


def memory(effort: Effort) -> list[Figure]:
    """A process of its own fills a buffer, samples from it and says how much it grew."""
    if resource is None:
        row = f"replay of {effort.replay_rows:,} Half-Cheetah rows"
        return [Figure(row=row, against="the bare numbers", note="this system does not tell how much a process holds")]
    return in_fresh_process(measure, effort)


def measure(effort: Effort) -> list[Figure]:
    """To be run in a process that has done nothing else."""
    rows = random_rows(min(CHUNK, effort.replay_rows), 1)
    bare = sum(value.numel() * value.element_size() for value in rows.values(True, True)) / len(rows)
    before = resident()
    buffer = TransitionBuffer(effort.replay_rows, seed=0)
    for start in range(0, effort.replay_rows, len(rows)):
        buffer.extend(rows[: effort.replay_rows - start])
    sample_batches(buffer, num_batches=50)
    grown = peak() - before  # sampling included
    return [
        Figure(
            row=f"replay of {effort.replay_rows:,} Half-Cheetah rows",
            against="the bare numbers",
            ratios=(grown / (bare * effort.replay_rows),),
            amounts=(grown / GIGABYTE,),
            unit="GB",
            target=Target(1.5, of="amount"),
            note=f"{len(buffer):,} rows of {bare:.0f} bytes; the whole process at its peak: {peak() / GIGABYTE:.2f} GB",
        )
    ]


def resident() -> int:
    """What this process holds now, bytes (where the system does not tell: the most so far)."""
    path = Path("/proc/self/statm")
    return int(path.read_text().split()[1]) * resource.getpagesize() if path.exists() else peak()


def peak() -> int:
    """Most memory that this process has held so far, bytes (macOS counts in bytes, other systems in KiB)."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
