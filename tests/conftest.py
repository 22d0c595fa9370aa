"""Fixtures of all tests."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from toy_env import ToyEnv, random_rows

# Threads that wait for each other inside of tiny products collapse when another process wants the same cores.
torch.set_num_threads(1)


@pytest.fixture
def toy_env() -> ToyEnv:
    """A ToyEnv of one run."""
    return ToyEnv()


@pytest.fixture
def make_rows() -> Callable[..., TensorDict]:
    """``make_rows(*batch, seed=0, dtype=torch.float64)``: random transitions of a ToyEnv."""
    return random_rows
