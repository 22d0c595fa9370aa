"""Rows: the two design searches on trained networks, seconds and the value that they reach."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from benchmarks.effort import Effort
from benchmarks.floors import Product, alone, design_value_products
from benchmarks.measure import Figure, Target, interleaved, over
from benchmarks.networks import load
from benchmarks.parts import body_sizes
from benchmarks.updates import FLOOR
from coim import DesignValue, GradientSearch, MorphEnv, ParticleSwarm
from coim.designs import DesignSearch

FLOOR_SHARE = 5  # the floor is timed over this part of the swarm's evaluations


def search(effort: Effort) -> list[Figure]:
    """One thread; each repeat draws other start states and seeds both searches anew."""
    return [figure for body in effort.searched for figure in _on(body, effort)]


def _on(body: str, effort: Effort) -> list[Figure]:
    env, policy, qvalue, starts = load(body)
    spec, repeats = env.design_spec, effort.long_repeats
    draws = [
        starts[torch.randperm(len(starts), generator=torch.Generator().manual_seed(k))[: effort.num_start_states]]
        for k in range(repeats)
    ]
    exact = [DesignValue(policy, qvalue, draw) for draw in draws]
    rounded = [DesignValue(policy, qvalue, draw, precision="bfloat16") for draw in draws]

    def swarm(k: int) -> ParticleSwarm:
        return ParticleSwarm(spec, num_particles=effort.num_particles, num_iterations=effort.num_iterations, seed=k)

    runs = {
        "swarm": Searches(exact, exact, swarm),
        "swarm bfloat16": Searches(rounded, exact, swarm),
        "gradient": Searches(exact, exact, lambda k: GradientSearch(spec, seed=k)),
    }
    evaluations = max(1, effort.num_iterations // FLOOR_SHARE)
    floor = alone(_products(env, effort), times=evaluations)
    times = interleaved({"floor": floor, **runs}, repeats, warm_up=False)
    floors = [seconds * effort.num_iterations / evaluations for seconds in times["floor"]]
    values = {name: searches.values for name, searches in runs.items()}
    size, unit = f"{effort.num_particles} x {effort.num_iterations}", "s"
    lost = [1 - a / b for a, b in zip(values["swarm bfloat16"], values["swarm"])]
    return [
        Figure(
            row=f"swarm {size}, {body}, float32",
            against=FLOOR,
            ratios=over(times["swarm"], floors),
            amounts=tuple(times["swarm"]),
            unit=unit,
            target=Target(1.3),
            note="reaches Q " + ", ".join(f"{value:.5g}" for value in values["swarm"]),
        ),
        Figure(
            row=f"swarm {size}, {body}, bfloat16",
            against=FLOOR,
            ratios=over(times["swarm bfloat16"], floors),
            amounts=tuple(times["swarm bfloat16"]),
            unit=unit,
            note=f"its design loses at most {max(lost):.2%} of Q in float32",
        ),
        Figure(
            row=f"gradient search, {body}, time",
            against="swarm",
            ratios=over(times["gradient"], times["swarm"]),
            amounts=tuple(times["gradient"]),
            unit=unit,
            target=Target(0.1),
        ),
        Figure(
            row=f"gradient search, {body}, Q",
            against="swarm",
            ratios=over(values["gradient"], values["swarm"]),
            amounts=tuple(values["gradient"]),
            unit="Q",
            target=Target(0.99, sense=">="),
        ),
    ]


def _products(env: MorphEnv, effort: Effort) -> list[Product]:
    """Products of one evaluation of the whole swarm, in the chunks in which `DesignValue` takes them."""
    designs = max(1, 2_000 // effort.num_start_states)
    chunks = [len(part) * effort.num_start_states for part in torch.arange(effort.num_particles).split(designs)]
    sizes: dict[str, Any] = body_sizes(env)
    return design_value_products(chunks=chunks, cells=effort.num_cells, **sizes)


class Searches:
    """One search after the other, each over start states of its own.

    Args:
        fitness: what search k maximises.
        judge: what the design that it finds is worth.
        make: search k.
    """

    def __init__(
        self, fitness: list[DesignValue], judge: list[DesignValue], make: Callable[[int], DesignSearch]
    ) -> None:
        self.fitness, self.judge, self.make = fitness, judge, make
        self.values: list[float] = []

    def __call__(self) -> None:
        """Search, and keep the value of what was found."""
        k = len(self.values)
        design, _ = self.make(k).maximise(self.fitness[k])
        with torch.no_grad():
            self.values.append(float(self.judge[k](design.unsqueeze(0))[0]))
