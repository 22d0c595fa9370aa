"""Rows: the update against Stable-Baselines3 and SBX, where these are installed (``make bench``)."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
from collections.abc import Callable
from functools import partial
from statistics import median
from typing import Any

import gymnasium
import numpy as np

from benchmarks.effort import SMALL, Effort
from benchmarks.floors import alone
from benchmarks.fresh import in_fresh_process
from benchmarks.measure import Figure, Target, interleaved, over
from benchmarks.parts import REPLAY_ROWS, body_sizes, replay, update_products
from benchmarks.updates import our_updates, plural, small_networks, too_few_cores
from coim import HalfCheetahMorph
from coim.experiments.run.machine import available_cores

RIVALS = {"sb3": ("stable_baselines3", "Stable-Baselines3"), "sbx": ("sbx", "SBX, scanned")}


def sb3(effort: Effort) -> list[Figure]:
    """Stable-Baselines3's `SAC.train`, PyTorch eager."""
    return _against("sb3", effort)


def sbx(effort: Effort) -> list[Figure]:
    """SBX's `SAC.train`, JAX, all updates in one jitted call; also with small networks."""
    small = dataclasses.replace(effort, num_cells=SMALL)
    return _against("sbx", effort) + _against("sbx", small, of=f"update of {small_networks()}")


def _against(rival: str, effort: Effort, *, of: str = "update") -> list[Figure]:
    """JAX takes its threads from the cores of the process: one process for each number of threads."""
    module, name = RIVALS[rival]
    found = []
    for count in effort.threads:
        row = f"{of}, {plural(count)}, K = 1, float32"
        if importlib.util.find_spec(module) is None:
            found.append(Figure(row=row, against=name, note="not installed; `make bench` installs it"))
        elif count > available_cores():
            found.append(Figure(row=row, against=name, note=too_few_cores(count)))
        else:
            found += in_fresh_process(partial(measure, rival, count, row), effort, cores=count)
    return found


def measure(rival: str, count: int, row: str, effort: Effort) -> list[Figure]:
    """To be run in a process that is confined to so many cores."""
    name = RIVALS[rival][1]
    times = interleaved(
        {
            "floor": alone(update_products(effort), times=effort.updates),
            "ours": our_updates(replay(1), effort, effort.updates),
            "theirs": _their_updates(rival, effort),
        },
        effort.repeats,
    )
    ours, theirs = (median(over(times[who], times["floor"])) for who in ("ours", "theirs"))
    return [
        Figure(
            row=row,
            against=name,
            ratios=over(times["ours"], times["theirs"]),
            amounts=tuple(1e3 * seconds / effort.updates for seconds in times["ours"]),
            unit="ms",
            target=Target(1.0, sense="<") if rival == "sbx" and count == 1 else None,
            note=f"{name} is at {theirs:.2f} x floor, this at {ours:.2f}",
        )
    ]


class Box(gymnasium.Env):
    """Half-Cheetah's sizes, design included, and nothing else: it is never stepped."""

    def __init__(self) -> None:
        sizes = body_sizes(HalfCheetahMorph(seed=0))
        states = sizes["observations"] + sizes["designs"]
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (states,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (sizes["actions"],), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Zeros."""
        return np.zeros_like(self.observation_space.sample()), {}


def _their_updates(rival: str, effort: Effort) -> Callable[[], None]:
    # Neither need be installed.
    make: Any = importlib.import_module(RIVALS[rival][0]).SAC
    logger: Any = importlib.import_module("stable_baselines3.common.logger").Logger
    model = make(
        "MlpPolicy",
        Box(),
        buffer_size=REPLAY_ROWS,
        ent_coef=0.01,
        gamma=0.99,
        tau=0.005,
        policy_kwargs={"net_arch": list(effort.num_cells)},
        device="cpu",
        seed=0,
    )
    model.set_logger(logger(folder=None, output_formats=[]))
    draw = np.random.default_rng(0)
    for _ in range(REPLAY_ROWS):
        state, following = draw.standard_normal((2, 1, *model.observation_space.shape), np.float32)
        action, reward = np.tanh(draw.standard_normal((1, *model.action_space.shape), np.float32)), np.zeros(1)
        model.replay_buffer.add(state, following, action, reward, np.zeros(1), [{}])

    def run() -> None:
        model.train(gradient_steps=effort.updates, batch_size=effort.batch_size)

    return run
