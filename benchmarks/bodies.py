"""Rows: env steps per second with the policy, three bodies."""

from __future__ import annotations

import torch

from benchmarks.effort import Effort
from benchmarks.measure import Figure, Target, interleaved, over
from coim import make_policy, run_episode
from coim.envs import BODIES

REACH = {"half_cheetah": {1: 8_000, 64: 22_000}, "walker": {1: 4_500, 64: 9_500}, "hopper": {1: 5_500, 64: 14_000}}


def bodies(effort: Effort) -> list[Figure]:
    """`run_episode` with a fresh policy, reset included, against the physics alone; one thread."""
    return [_steps(name, runs, effort) for name in REACH for runs in effort.fleets]


def _steps(name: str, runs: int, effort: Effort) -> Figure:
    steps = effort.episode_steps if runs == 1 else effort.fleet_steps
    env, still = (BODIES[name](num_runs=runs, episode_steps=steps, seed=seed) for seed in (0, 1))
    policy = make_policy(env, num_cells=effort.num_cells, num_runs=runs if runs > 1 else None)
    generator = torch.Generator().manual_seed(0)
    torques = (torch.rand(steps, *env.action_spec.shape, generator=generator) * 2 - 1).numpy()

    def physics() -> None:
        still.reset()
        for torque in torques:
            still.simulations.ctrl[:] = torque
            still.simulations.step(still.FRAME_SKIP)

    times = interleaved(
        {"physics": physics, "episode": lambda: run_episode(env, policy, rng=generator)},
        effort.repeats if runs == 1 else effort.long_repeats,
    )
    reach = REACH[name].get(runs)
    return Figure(
        row=f"steps with policy, {name}, K = {runs}",
        against="physics alone",
        ratios=over(times["episode"], times["physics"]),
        amounts=tuple(steps * runs / seconds for seconds in times["episode"]),
        unit="steps/s",
        target=None if reach is None else Target(reach, of="amount", sense=">="),
    )
