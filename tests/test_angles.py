"""Wrapped angles."""

from __future__ import annotations

import math

import pytest
import torch

from coim.angles import wrap_angle


def test_angles_inside_the_range_keep_every_bit():
    angles = torch.linspace(-3.14159, math.pi, 10_001)
    assert torch.equal(wrap_angle(angles), angles)


@pytest.mark.parametrize("turns", [-3, -1, 1, 2])
def test_full_turns_are_taken_off(turns):
    angles = torch.linspace(-3.1, 3.1, 101, dtype=torch.float64)
    torch.testing.assert_close(wrap_angle(angles + turns * math.tau), angles, rtol=0, atol=1e-12)


def test_the_range_is_open_below_and_closed_above():
    assert wrap_angle(torch.tensor([math.pi, -math.pi], dtype=torch.float64)).tolist() == [math.pi, math.pi]


def test_gradients_pass_as_through_the_angle_itself():
    angle = torch.tensor([0.5, 4.0, -9.0], requires_grad=True)
    wrap_angle(angle).sum().backward()
    assert angle.grad is not None
    assert angle.grad.tolist() == [1.0, 1.0, 1.0]
