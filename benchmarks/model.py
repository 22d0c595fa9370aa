"""Rows: the ensemble's update, and imagination."""

from __future__ import annotations

from collections.abc import Callable
from statistics import median
from typing import Any

import torch

from benchmarks.effort import Effort
from benchmarks.floors import alone, imagination_products
from benchmarks.measure import Figure, Target, interleaved, over, threads
from benchmarks.parts import body_sizes, dynamics_learner, model_products, random_rows, replay
from benchmarks.updates import FLOOR, PRODUCTS_BY, plural, too_few_cores
from coim import HalfCheetahMorph, NoisyDesigns, WorldModelEnv, imagine, make_policy, sample_batches
from coim.experiments.run.machine import available_cores
from coim.imagination import CHUNK_ROWS
from coim.learners.flat_weights import Precision
from coim.products import chosen


def ensemble(effort: Effort) -> list[Figure]:
    """Sampling, gradients and Adam of the three members."""
    found = []
    for count in effort.threads:
        if count > available_cores():
            found.append(Figure(row=f"ensemble update, {plural(count)}", against=FLOOR, note=too_few_cores(count)))
            continue
        with threads(count):
            found += _ensemble(effort, count)
    return found


def _ensemble(effort: Effort, count: int) -> list[Figure]:
    updates = max(1, effort.updates // 4)
    buffer, listed = replay(1), model_products(effort)

    def ours(precision: Precision = "float32", *, compile: bool = True) -> Callable[[], object]:
        learner = dynamics_learner(effort, precision=precision, compile=compile)
        return lambda: learner.update(
            sample_batches(buffer, batch_size=effort.batch_size, num_batches=updates)[:, :, 0]
        )

    candidates = {
        "float32": ours(),
        "float32, not compiled": ours(compile=False),
        "bfloat16": ours("bfloat16"),
    }
    floors = {"floor": alone(listed, times=updates), "products": alone(listed, times=updates, by=chosen())}
    times = interleaved(floors | candidates, effort.repeats)
    return [
        Figure(
            row=f"ensemble update, {plural(count)}, {name}",
            against=FLOOR,
            ratios=over(times[name], times["floor"]),
            amounts=tuple(1e3 * seconds / updates for seconds in times[name]),
            unit="ms",
            target=Target(1.4) if name == "float32" else None,
            note=PRODUCTS_BY.format(median(over(times[name], times["products"]))) if name == "float32" else "",
        )
        for name in candidates
    ]


def imagination(effort: Effort) -> list[Figure]:
    """The refresh of Replay_Art: designs of G, actions, TS1, rewards, rows; one thread."""
    env = HalfCheetahMorph(seed=0)
    policy, learner = make_policy(env, num_cells=effort.num_cells), dynamics_learner(effort)
    dream = WorldModelEnv(learner.ensemble, env, batch_size=[1], seed=0)
    states, generator = random_rows(effort.imagined_rows), NoisyDesigns(env.design_spec, sigma=0.1)
    rng = torch.Generator().manual_seed(0)
    sizes: dict[str, Any] = body_sizes(env)
    chunks = [len(chunk) for chunk in torch.arange(effort.imagined_rows).split(CHUNK_ROWS["cpu"])]
    listed = imagination_products(chunks=chunks, cells=effort.num_cells, model_cells=effort.model_cells, **sizes)
    times = interleaved(
        {
            "floor": alone(listed),
            "coim": alone(listed, by=chosen()),
            "imagine": lambda: imagine(dream, states, policy, generator, rng=rng),
        },
        effort.repeats,
    )
    return [
        Figure(
            row=f"imagination, {effort.imagined_rows:,} rows, 1 thread",
            against=FLOOR,
            ratios=over(times["imagine"], times["floor"]),
            amounts=tuple(effort.imagined_rows / seconds for seconds in times["imagine"]),
            unit="rows/s",
            target=Target(1.4),
            note=PRODUCTS_BY.format(median(over(times["imagine"], times["coim"]))),
        )
    ]
