"""Rows that tell where they are from, and buffers of them.  T time steps, K runs, S state, A action, D design."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict

from coim.buffers import TransitionBuffer


def make_rows(T: int, K: int = 1, *, S: int = 2, D: int = 2, A: int = 1, first: float = 0.0) -> TensorDict:
    """Rows whose observation is ``first + t`` at time t, plus 1000 times the run."""
    time = first + torch.arange(T).float().view(T, 1, 1)
    own = time + 1000 * torch.arange(K).float().view(1, K, 1)
    flag = torch.zeros(T, K, 1, dtype=torch.bool)
    after = {"observation": own.expand(T, K, S) + 1, "design": torch.ones(T, K, D), "reward": torch.zeros(T, K, 1)}
    after |= {"terminated": flag, "truncated": flag, "done": flag}
    row = {"observation": own.expand(T, K, S), "design": torch.ones(T, K, D), "action": torch.zeros(T, K, A)}
    return TensorDict({**row, "next": after}, [T, K])


def filled(T: int, K: int = 1, *, seed: int = 0, first: float = 0.0, capacity: int | None = None) -> TransitionBuffer:
    buffer = TransitionBuffer(capacity or T, num_runs=K, seed=seed)
    buffer.extend(make_rows(T, K, first=first))
    return buffer


def keys_of(rows: TensorDict) -> set[Any]:
    return set(rows.keys(include_nested=True, leaves_only=True))
