"""Is a run that was killed and resumed the run that was never killed?

``python -m benchmarks.soak --kills 50`` makes small runs in peace, and then fifty that are killed (SIGKILL) at random
moments and resumed. It compares CSV files (but for the seconds), kept policies, parameters, optimisers, generators and
buffers, and says how many of the fifty were identical to the last bit.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import random
import signal
import tempfile
import time
from collections.abc import Iterator
from multiprocessing import forkserver, resource_tracker
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import torch
import tyro

from coim import HopperMorph
from coim.experiments.frames import read_frame, rows_of
from coim.experiments.run.atomic_write import dated_file
from coim.experiments.run.interrupt import on_command_line
from coim.experiments.run.results import Table
from coim.experiments.run.settings import Settings
from coim.experiments.train import main as main_of_recipe
from coim.experiments.train import run
from coim.run_folder import DESIGNS, EVALUATIONS, METRICS
from coim.tables import Layout

SMALL = Settings(
    num_designs=7,
    first_episodes=1,
    episodes=2,
    episode_steps=60,
    num_cells=(16, 16),
    model_cells=(16, 16),
    individual_updates=55,  # more than are drawn in one call
    population_updates=20,
    model_updates=20,
    batch_size=20,
    num_particles=20,
    num_iterations=20,
    num_start_states=5,
    threads=2,
    quiet=True,
)
# What a run can be made of: the paper's method, a fleet with noisy designs and mixed batches, the baseline, and the
# paper's method with compiled gradients.
KINDS = {
    "known designs": SMALL,
    "fleet": dataclasses.replace(SMALL, num_runs=3, imagine="noisy", individual_mix=0.2, individual_imagined_share=0.2),
    "baseline": dataclasses.replace(SMALL, imagine="none", search="gradient"),
    "compiled": dataclasses.replace(SMALL, compile=True),
}
PLAIN = multiprocessing.get_context("forkserver")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Soak:
    """Kill small runs at random moments, resume them, and compare them with one that was left alone."""

    kills: int = 50
    """Runs that are killed; each kind of run in turn."""
    seed: int = 0
    """Seeds the moments."""
    out: Path | None = None
    """Table with a row for each kill; by default runs/soak-DATE.csv."""


def main(soak: Soak) -> None:
    """Run, kill, resume, compare, write and print."""
    draw, identical = random.Random(soak.seed), 0
    out = soak.out or dated_file("soak", ".csv")
    out.parent.mkdir(parents=True, exist_ok=True)
    table = Table(out, ["kill", "kind", "killed_after_s", "last_checkpoint_s", "checkpoints_before", "identical"])
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        seconds = {}
        for kind, settings in KINDS.items():
            print(f"{kind}: a run in peace", flush=True)
            seconds[kind] = left_alone(folder / kind, settings)
        for i in range(soak.kills):
            kind = list(KINDS)[i % len(KINDS)]
            moment = draw.uniform(0, seconds[kind])
            victim = folder / str(i)
            before = killed_and_resumed(victim, KINDS[kind], moment)
            different = differences(folder / kind, victim)
            identical += not different
            row = [i + 1, kind, f"{moment:.3f}", f"{seconds[kind]:.3f}", before, not different]
            table.append([dict(zip(table.columns, row))])
            print(*row, *different[:3], sep="  ", flush=True)
    print(f"{identical} of {soak.kills} identical -> {out}")


def left_alone(folder: Path, settings: Settings) -> float:
    """Make a run in peace; returns when its last checkpoint was written, in s from its start."""
    started = time.time()
    finish(start(folder, settings))
    return last_state(folder, "algorithm").stat().st_mtime - started


def killed_and_resumed(folder: Path, settings: Settings, *moments: float) -> int:
    """Start a run, kill it after so many seconds, resume it, kill it again..., and let it end.

    Returns:
        The number of the last checkpoint before the last kill.
    """
    last = 0
    for moment in moments:
        process = start(folder, settings)
        try:
            process.join(moment)
        finally:
            process.kill()
        process.join()
        last = max([0, *(int(path.name.split("-")[1]) for path in folder.glob("checkpoint/checkpoint-*"))])
    finish(start(folder, settings))
    return last


def start(folder: Path, settings: Settings) -> BaseProcess:
    """Make or resume a run in a process of its own, out of one that has imported everything and computed nothing."""
    PLAIN.set_forkserver_preload(["coim.experiments.train"])
    # Who is killed cannot give its semaphores back; that they are collected in the end is no news.
    os.environ["PYTHONWARNINGS"] = "ignore:resource_tracker"
    # Ctrl-C at a terminal reaches that one too, which takes seconds to import and has no line of its own to say.
    resource_tracker.ensure_running()  # which lets Ctrl-C through when it has begun
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    process = PLAIN.Process(target=make_or_resume, args=(folder, settings))
    process.start()
    return process


def make_or_resume(folder: Path, settings: Settings) -> None:
    """Go on with a run as its user would, or start it if nothing but its folder was made."""
    os.setsid()  # Ctrl-C at a terminal is meant for its parent, which kills it
    if (folder / "config.json").exists():
        main_of_recipe(HopperMorph, "hopper", ["--resume", str(folder)])
    else:
        run(HopperMorph, "hopper", dataclasses.replace(settings, out=folder))


def finish(process: BaseProcess) -> None:
    """Wait for a process to end well; it is killed if this one is told to end."""
    try:
        process.join()
    except KeyboardInterrupt:
        process.kill()
        raise
    if process.exitcode:
        raise RuntimeError(f"the run ended with exit code {process.exitcode}; its last words are above")


def differences(one: Path, other: Path) -> list[str]:
    """Where two run folders differ: rows of CSV files but for the seconds, policies, what the last checkpoints hold."""
    found = []
    for layout in (EVALUATIONS, DESIGNS, METRICS):
        rows = [rows_without_seconds(folder, layout) for folder in (one, other)]
        found += [f"{layout.file} row {i}" for i, (a, b) in enumerate(zip(*rows)) if a != b]
        if len(rows[0]) != len(rows[1]):
            found.append(f"{layout.file}: {len(rows[0])} and {len(rows[1])} rows")
    states = {name: [last_state(folder, name) for folder in (one, other)] for name in ("algorithm", "best", "random")}
    policies = [{path.name for path in folder.glob("policies/*")} for folder in (one, other)]
    if policies[0] != policies[1]:
        found.append(f"policies: {sorted(policies[0] ^ policies[1])} are in one only")
    states |= {name: [folder / "policies" / name for folder in (one, other)] for name in policies[0] & policies[1]}
    for name, paths in states.items():
        found += unequal(*(torch.load(path, weights_only=True) for path in paths), path=name)
    if (one / "checkpoint/replay.bin").read_bytes() != (other / "checkpoint/replay.bin").read_bytes():
        found.append("replay.bin")
    return found


def rows_without_seconds(folder: Path, layout: Layout) -> list[dict[str, Any]]:
    """Rows of a CSV file but for what the clock says; None for a missing number, so that equal rows are equal."""
    rows = read_frame(folder / layout.file, layout)
    kept = rows[[name for name in rows.columns if not name.startswith("seconds")]].astype("object")
    return rows_of(kept.where(kept.notna(), None))


def last_state(folder: Path, component: str) -> Path:
    """File of a component in the newest checkpoint of a run."""
    newest = max(folder.glob("checkpoint/checkpoint-*"))
    return next(newest.glob(f"components/*-{component}/state.pt"))


def unequal(one: Any, other: Any, *, path: str) -> Iterator[str]:
    """Places where two nested states are not the same to the last bit."""
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        for key in one:
            yield from unequal(one[key], other[key], path=f"{path}.{key}")
    elif isinstance(one, tuple | list) and isinstance(other, tuple | list) and len(one) == len(other):
        for i, (a, b) in enumerate(zip(one, other)):
            yield from unequal(a, b, path=f"{path}.{i}")
    elif isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        if not same_bits(one, other):
            yield path
    elif type(one) is not type(other) or one != other:
        yield path


def same_bits(one: torch.Tensor, other: torch.Tensor) -> bool:
    """Whether two tensors are the same, NaN equal to NaN: a run that has diverged has no other numbers."""
    bits = [tensor.detach().contiguous().reshape(-1).view(torch.uint8) for tensor in (one, other)]
    return (one.shape, one.dtype) == (other.shape, other.dtype) and torch.equal(*bits)


if __name__ == "__main__":
    with on_command_line(own_process=True):
        main(tyro.cli(Soak, prog="python -m benchmarks.soak", description=__doc__))
