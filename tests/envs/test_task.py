"""Directions."""

from __future__ import annotations

import pytest
import torch

from coim.envs.task import speed_along


def test_backward_turns_the_sign_of_the_speed():
    velocity = torch.tensor([1.5, -2.0])
    assert speed_along("forward", velocity).tolist() == [1.5, -2.0]
    assert speed_along("backward", velocity).tolist() == [-1.5, 2.0]


def test_an_unknown_task_names_the_choices():
    with pytest.raises(ValueError, match="unknown task 'sideways'; choose 'forward' or 'backward'"):
        speed_along("sideways", torch.zeros(1))  # type: ignore[arg-type]
