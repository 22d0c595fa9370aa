"""Learners of a ToyEnv: small, in double precision unless told otherwise, and the same each time that they are made."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict
from toy_env import ToyEnv

from coim import DynamicsLearner, GaussianEnsemble, SACLearner, make_policy, make_qvalue

# A learning rate that is exact in float32, in which a CUDA graph reads it.
LR = 0.5**12

Rows = Callable[..., TensorDict]  # the fixture make_rows


def sac_learner(
    num_runs: int | None = None,
    *,
    seed: int = 0,
    num_cells: Sequence[int] = (16, 16),
    num_critics: int = 2,
    dtype: torch.dtype = torch.float64,
    device: str = "cpu",
    **settings: Any,
) -> SACLearner:
    """A SACLearner; the seed is that of its weights and of its noise."""
    torch.manual_seed(seed)
    env = ToyEnv()
    policy = make_policy(env, num_cells=num_cells, num_runs=num_runs)
    qvalue = make_qvalue(env, num_critics=num_critics, num_cells=num_cells, num_runs=num_runs)
    networks = (network.to(dtype).to(device) for network in (policy, qvalue))
    return SACLearner(*networks, num_runs=num_runs, seed=seed, **settings)


def dynamics_learner(
    num_runs: int | None = None,
    *,
    seed: int = 0,
    num_cells: Sequence[int] = (16, 16),
    num_members: int = 3,
    dtype: torch.dtype = torch.float64,
    device: str = "cpu",
    **settings: Any,
) -> DynamicsLearner:
    """A DynamicsLearner that has seen no rows."""
    torch.manual_seed(seed)
    ensemble = GaussianEnsemble.for_env(ToyEnv(), num_members=num_members, num_cells=num_cells, num_runs=num_runs)
    return DynamicsLearner(ensemble.to(dtype).to(device), num_runs=num_runs, **settings)


def give_noise(learner: SACLearner, noise: Sequence[torch.Tensor]) -> None:
    """Let a learner take this noise instead of its own draws: first that of the states, then of the next states."""
    drawn = iter(noise)
    learner._noise = lambda action: next(drawn)  # type: ignore[method-assign]


def weights(learner: SACLearner) -> dict[str, torch.Tensor]:
    """All weights and targets of a learner, as they are now."""
    return {key: value.clone() for key, value in learner.loss.state_dict().items()}
