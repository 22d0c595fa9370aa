"""Half-Cheetah's sizes, and random rows and fresh learners of them, that several rows of the table share.

Shapes: U updates, B batch, K runs, T rows.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict

from benchmarks.effort import Effort
from benchmarks.floors import Product, ensemble_products, sac_products
from coim import (
    DynamicsLearner,
    GaussianEnsemble,
    HalfCheetahMorph,
    MorphEnv,
    SACLearner,
    TransitionBuffer,
    make_policy,
    make_qvalue,
)
from coim.learners.flat_weights import Precision

REPLAY_ROWS = 5_000  # enough that batches differ, few enough for sixteen runs


def body_sizes(env: MorphEnv) -> dict[str, int]:
    """S, D and A of a body, by the names of `benchmarks.floors`."""
    return {
        "observations": env.observation_spec["observation"].shape[-1],
        "designs": env.design_spec.shape[-1],
        "actions": env.action_spec.shape[-1],
    }


def update_products(effort: Effort) -> list[Product]:
    """Products of one update of policy and critics."""
    sizes: dict[str, Any] = body_sizes(HalfCheetahMorph(seed=0))
    return sac_products(batch=effort.batch_size, cells=effort.num_cells, **sizes)


def model_products(effort: Effort) -> list[Product]:
    """Products of one update of the ensemble."""
    sizes: dict[str, Any] = body_sizes(HalfCheetahMorph(seed=0))
    return ensemble_products(batch=effort.batch_size, cells=effort.model_cells, **sizes)


def random_rows(*batch: int, seed: int = 0) -> TensorDict:
    """Half-Cheetah rows in the schema of all buffers, normally distributed, ``[*batch]``."""
    env = HalfCheetahMorph(seed=0)
    sizes, generator = body_sizes(env), torch.Generator().manual_seed(seed)

    def normal(size: int) -> torch.Tensor:
        return torch.randn(*batch, size, generator=generator)

    observation = normal(sizes["observations"]) * env.observation_scale
    design = 0.8 + 1.2 * torch.rand(*batch, sizes["designs"], generator=generator)
    never = torch.zeros(*batch, 1, dtype=torch.bool)
    after = {"observation": observation + 0.1 * normal(sizes["observations"]), "design": design, "reward": normal(1)}
    after |= {key: never.clone() for key in ("terminated", "truncated", "done")}
    row = {"observation": observation, "design": design, "action": normal(sizes["actions"]).tanh(), "next": after}
    return TensorDict(row, batch)


def replay(num_runs: int, *, device: torch.device | str = "cpu") -> TransitionBuffer:
    """A buffer full of random rows."""
    buffer = TransitionBuffer(REPLAY_ROWS, num_runs=num_runs, seed=0, device=device)
    buffer.extend(random_rows(REPLAY_ROWS, num_runs))
    return buffer


def sac_learner(
    effort: Effort,
    *,
    num_runs: int = 1,
    precision: Precision = "float32",
    compile: bool = True,
    device: torch.device | str = "cpu",
) -> SACLearner:
    """Fresh policy and critics."""
    env, stacked = HalfCheetahMorph(seed=0), num_runs if num_runs > 1 else None
    return SACLearner(
        make_policy(env, num_cells=effort.num_cells, num_runs=stacked).to(device),
        make_qvalue(env, num_cells=effort.num_cells, num_runs=stacked).to(device),
        num_runs=stacked,
        precision=precision,
        compile=compile,
    )


def dynamics_learner(effort: Effort, *, precision: Precision = "float32", compile: bool = True) -> DynamicsLearner:
    """A fresh ensemble that has seen the scale of random rows."""
    ensemble = GaussianEnsemble.for_env(HalfCheetahMorph(seed=0), num_cells=effort.model_cells)
    learner = DynamicsLearner(ensemble, precision=precision, compile=compile)
    learner.observe(random_rows(REPLAY_ROWS))
    return learner
