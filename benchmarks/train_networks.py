"""Train what the design searches are measured on: ``python -m benchmarks.train_networks`` (five minutes).

Algorithm 1 without imagination: two short episodes on each of many designs, and a population that learns more than it
usually would in so few. The weights under ``benchmarks/data/`` are its own, made with the defaults and
``--out benchmarks/data``.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import tyro

from benchmarks.networks import TRAINED, save
from coim import EpisodeDone
from coim.envs import BODIES
from coim.experiments.run.build import build
from coim.experiments.run.interrupt import on_command_line
from coim.experiments.run.machine import available_cores, checked_device, prepare
from coim.experiments.run.settings import Settings


@dataclasses.dataclass(frozen=True, kw_only=True)
class Training:
    """Which networks, and for how long."""

    bodies: tuple[str, ...] = TRAINED
    """One file for each of them."""
    num_designs: int = 25
    """Bodies tried; after the first five, optimised and random ones in turn."""
    episodes: int = 2
    """Training episodes on each."""
    updates: int = 400
    """Population updates after each episode."""
    out: Path = Path("runs/networks")
    """Where the files go."""


def main(training: Training) -> None:
    """Train and save."""
    threads = available_cores()
    side_by_side = prepare(threads, checked_device("cpu"))
    settings = Settings(
        imagine="none",
        search="gradient",
        num_designs=training.num_designs,
        first_episodes=training.episodes,
        episodes=training.episodes,
        individual_updates=training.updates // 2,
        population_updates=training.updates,
    )
    for body in training.bodies:
        algorithm = build(BODIES[body], settings, threads=threads, side_by_side=side_by_side)
        for event in algorithm:
            if isinstance(event, EpisodeDone):
                print(body, event.index + 1, event.kind, f"{float(event.evaluation_return):.4g}", flush=True)
        population, starts = algorithm.population, algorithm.buffers.s0[:][:, 0]
        save(training.out / f"{body}.pt", population.policy, population.qvalue, starts)


if __name__ == "__main__":
    with on_command_line(own_process=True):
        main(tyro.cli(Training, description=__doc__))
