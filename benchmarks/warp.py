"""Rows: steps per second of a fleet's physics by MuJoCo Warp on a device, against MuJoCo on the host's cores.

``python -m benchmarks.warp --runs 16 --device cpu`` prints them, and how far off a step is.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from collections.abc import Callable

import numpy as np
import torch
import tyro
from tensordict import TensorDict

from benchmarks import table
from benchmarks.effort import Effort
from benchmarks.measure import Figure, interleaved, over
from coim.envs import BODIES, MorphEnv
from coim.experiments.run.machine import available_cores

STEPS = 100  # from one of MuJoCo's own states to the next


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """What to measure."""

    robots: tuple[str, ...] = tuple(BODIES)
    """Robots by name."""
    runs: int = 256
    """K, bodies that step together."""
    steps: int = 400
    """Steps of an episode."""
    device: str = "cuda"
    """Device of MuJoCo Warp; on cpu it is slow, and says how far off it is all the same."""


def main(options: Options) -> None:
    """Measure and print the table."""
    if lack := missing():
        sys.exit(lack)
    effort = Effort(fleet_steps=options.steps)
    device = torch.device(options.device)
    print(table.text([row for name in options.robots for row in physics(name, options.runs, effort, device)]))


def missing() -> str | None:
    """Why nothing can be measured; None if it can."""
    return None if importlib.util.find_spec("mujoco_warp") else "MuJoCo Warp is not installed: pip install 'coim[warp]'"


def physics(name: str, runs: int, effort: Effort, device: torch.device) -> list[Figure]:
    """Random actions on uniform bodies: how fast, and how far off after one step from the same state.

    Args:
        name: of the robot.
        runs: K, bodies that step together.
        effort: repeats and steps.
        device: of MuJoCo Warp.
    """
    generator = torch.Generator().manual_seed(0)
    low, high = BODIES[name].design_bounds()
    bodies = (low + torch.rand(runs, len(low), generator=generator) * (high - low)).float()
    host, there = (
        _fleet(name, bodies, **how)
        for how in ({"num_threads": available_cores()}, {"physics": "warp", "device": device})
    )
    start = host.get_simulation_state()
    actions = 2 * torch.rand(effort.fleet_steps, *host.action_spec.shape, generator=generator) - 1

    def episode(env: MorphEnv) -> Callable[[], None]:
        def run() -> None:
            env.set_simulation_state(start)
            for action in actions:
                env.move(action)

        return run

    differences = one_step_differences(host, there, actions[:STEPS])
    times = interleaved({"host": episode(host), "there": episode(there)}, effort.long_repeats)
    steps = effort.fleet_steps * runs
    return [
        Figure(
            row=f"physics by MuJoCo Warp, {name}, K = {runs}",
            against=f"MuJoCo on {available_cores()} cores",
            ratios=over(times["there"], times["host"]),
            amounts=tuple(steps / seconds for seconds in times["there"]),
            unit="steps/s",
            note="off after a step (median, 90 %, largest): "
            + ", ".join(f"{x:.2g}" for x in np.quantile(differences, (0.5, 0.9, 1))),
        )
    ]


def one_step_differences(truth: MorphEnv, env: MorphEnv, actions: torch.Tensor) -> np.ndarray:
    """Largest difference of an observation after a step of each body from MuJoCo's own states, ``[T, K]``."""
    found = []
    for action in actions:
        env.set_simulation_state(truth.get_simulation_state())
        found.append((env.move(action)[0] - truth.move(action)[0]).abs().amax(-1))
    return torch.stack(found).numpy()


def _fleet(name: str, bodies: torch.Tensor, **how: object) -> MorphEnv:
    env = BODIES[name](num_runs=len(bodies), seed=0, **how)
    env.reset(TensorDict({"design": bodies}, env.batch_size).to(env.device or "cpu"))
    return env


if __name__ == "__main__":
    main(tyro.cli(Options, prog="python -m benchmarks.warp", description=__doc__))
