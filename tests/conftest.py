"""Fixtures of all tests."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from toy_env import ToyEnv, random_rows

from coim.models import Policy, QValue, make_policy, make_qvalue


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip what is marked ``gpu`` where there is none."""
    if item.get_closest_marker("gpu") and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")


@pytest.fixture(autouse=True)
def same_draws() -> None:
    """Let a test that draws from torch's own generator draw the same after whatever ran before it."""
    torch.manual_seed(4321)  # no seed of a generator in the tests, whose draws would be the same


@pytest.fixture
def toy_env() -> ToyEnv:
    """A ToyEnv of one run."""
    return ToyEnv()


@pytest.fixture
def make_rows() -> Callable[..., TensorDict]:
    """``make_rows(*batch, seed=0, dtype=torch.float64)``: random transitions of a ToyEnv."""
    return random_rows


@pytest.fixture
def policy(toy_env: ToyEnv) -> Policy:
    """A small policy in double precision."""
    return make_policy(toy_env, num_cells=(8, 8)).double()


@pytest.fixture
def qvalue(toy_env: ToyEnv) -> QValue:
    """Its critics."""
    return make_qvalue(toy_env, num_cells=(8, 8)).double()


@pytest.fixture
def single_critics(toy_env: ToyEnv) -> list[QValue]:
    """Two critics, each a network of its own."""
    return [make_qvalue(toy_env, num_critics=1, num_cells=(8, 8)).double() for _ in range(2)]
