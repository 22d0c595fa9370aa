"""Directions and wrapped angles."""

from __future__ import annotations

import math

import pytest
import torch

from coim.envs.task import speed_along, wrap_angle


def test_backward_turns_the_sign_of_the_speed():
    velocity = torch.tensor([1.5, -2.0])
    assert speed_along("forward", velocity).tolist() == [1.5, -2.0]
    assert speed_along("backward", velocity).tolist() == [-1.5, 2.0]


def test_an_unknown_task_names_the_choices():
    with pytest.raises(ValueError, match="unknown task 'sideways'; choose 'forward' or 'backward'"):
        speed_along("sideways", torch.zeros(1))  # type: ignore[arg-type]


def test_angles_inside_the_range_keep_every_bit():
    angles = torch.linspace(-3.14159, math.pi, 10_001)
    assert torch.equal(wrap_angle(angles), angles)


@pytest.mark.parametrize("turns", [-3, -1, 1, 2])
def test_full_turns_are_taken_off(turns):
    angles = torch.linspace(-3.1, 3.1, 101, dtype=torch.float64)
    torch.testing.assert_close(wrap_angle(angles + turns * math.tau), angles, rtol=0, atol=1e-12)


def test_the_range_is_open_below_and_closed_above():
    assert wrap_angle(torch.tensor([math.pi, -math.pi], dtype=torch.float64)).tolist() == [math.pi, math.pi]
