"""Fixtures of all tests."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from tensordict import TensorDict
from toy_env import ToyEnv, random_rows


@pytest.fixture
def toy_env() -> ToyEnv:
    """A ToyEnv of one run."""
    return ToyEnv()


@pytest.fixture
def make_rows() -> Callable[..., TensorDict]:
    """``make_rows(*batch, seed=0, dtype=torch.float64)``: random transitions of a ToyEnv."""
    return random_rows
