"""Rows: env steps per second with the policy, three bodies, from Python and in native code."""

from __future__ import annotations

from collections.abc import Callable

import torch

from benchmarks.effort import Effort
from benchmarks.measure import Figure, Target, interleaved, over
from coim import make_policy, run_episode
from coim.envs import BODIES

REACH = {"half_cheetah": {1: 8_000, 64: 22_000}, "walker": {1: 4_500, 64: 9_500}, "hopper": {1: 5_500, 64: 14_000}}
NATIVE_REACH = {"half_cheetah": {1: 1.6, 64: 1.3}, "walker": {1: 1.3, 64: 1.3}, "hopper": {1: 1.4, 64: 1.3}}


def bodies(effort: Effort) -> list[Figure]:
    """`run_episode` with a fresh policy, reset included, against the physics alone; one thread."""
    return [figure for name in REACH for runs in effort.fleets for figure in _steps(name, runs, effort)]


def _steps(name: str, runs: int, effort: Effort) -> list[Figure]:
    steps = effort.episode_steps if runs == 1 else effort.fleet_steps
    env, still = (BODIES[name](num_runs=runs, episode_steps=steps, seed=0) for _ in range(2))
    policy = make_policy(env, num_cells=effort.num_cells, num_runs=runs if runs > 1 else None)
    generator = torch.Generator().manual_seed(0)
    # What physics takes depends on what touches the floor: all go through the same episode.
    start = still.get_simulation_state()
    torques = run_episode(env, policy, rng=generator, native=True)["action"].numpy()

    def physics() -> None:
        still.set_simulation_state(start)
        still.reset()
        for torque in torques:
            still.simulations.ctrl[:] = torque
            still.simulations.step(still.FRAME_SKIP)

    def episode(native: bool) -> Callable[[], object]:
        def act() -> None:
            env.set_simulation_state(start)
            run_episode(env, policy, rng=generator.manual_seed(0), native=native)

        return act

    times = interleaved(
        {"physics": physics, "python": episode(native=False), "native": episode(native=True)},
        effort.repeats if runs == 1 else effort.long_repeats,
    )
    reach, of_native = REACH[name].get(runs), NATIVE_REACH[name].get(runs)
    targets = {
        "python": None if reach is None else Target(reach, of="amount", sense=">="),
        "native": None if of_native is None else Target(of_native),
    }
    return [
        Figure(
            row=f"steps with policy, {'native, ' if way == 'native' else ''}{name}, K = {runs}",
            against="physics alone",
            ratios=over(times[way], times["physics"]),
            amounts=tuple(steps * runs / seconds for seconds in times[way]),
            unit="steps/s",
            target=target,
        )
        for way, target in targets.items()
    ]
