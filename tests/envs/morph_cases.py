"""Bodies, designs and actions that the tests of fleets share."""

from __future__ import annotations

import pytest
import torch

from coim.envs import HalfCheetahMorph, HopperMorph, MorphEnv, WalkerMorph

BODIES = pytest.mark.parametrize("body", [HalfCheetahMorph, WalkerMorph, HopperMorph])


def some_designs(env: MorphEnv, seed: int = 0) -> torch.Tensor:
    low, high = env.DESIGN_BOUNDS
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(env.numel(), env.DESIGN_SIZE, generator=generator)


def some_actions(env: MorphEnv, num_steps: int, seed: int = 0) -> torch.Tensor:
    return 2 * torch.rand(num_steps, *env.action_spec.shape, generator=torch.Generator().manual_seed(seed)) - 1
