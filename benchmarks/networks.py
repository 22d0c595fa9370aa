"""Networks that were trained by `benchmarks.train_networks`: what a design search meets in a real run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from coim import MorphEnv, Policy, QValue, make_policy, make_qvalue
from coim.envs import BODIES

TRAINED = ("half_cheetah", "hopper")
FOLDER = Path(__file__).parent / "data"


def save(path: Path, policy: Policy, qvalue: QValue, starts: TensorDict) -> None:
    """Write weights and start states ``[n]`` in float16: a megabyte for two bodies."""
    parts: dict[str, dict[str, Any]] = {
        "policy": policy.state_dict(),
        "qvalue": qvalue.state_dict(),
        "starts": dict(starts.select("observation", "design").items()),
    }
    halves = {name: {key: value.half() for key, value in part.items()} for name, part in parts.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(halves, path)


def load(body: str) -> tuple[MorphEnv, Policy, QValue, TensorDict]:
    """A body, its trained population policy and critics, and the start states that they were trained from."""
    env = BODIES[body](seed=0)
    policy, qvalue = make_policy(env), make_qvalue(env)
    parts = torch.load(FOLDER / f"{body}.pt", weights_only=True)
    policy.load_state_dict(parts["policy"])
    qvalue.load_state_dict(parts["qvalue"])
    starts = {key: value.float() for key, value in parts["starts"].items()}
    return env, policy, qvalue, TensorDict(starts, [len(starts["design"])])
