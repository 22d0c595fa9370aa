"""Native updates of networks that a caller has made; those of the learners are tested with the learners."""

from __future__ import annotations

from itertools import chain, pairwise

import pytest
import torch
from torch import Tensor

from coim.learners.captured import FlatAdam
from coim.learners.flat_weights import views
from coim.objectives.gradients import Network
from coim.objectives.native_gradients import (
    NativeDynamics,
    dynamics_updates,
)


def members_in_one_buffer(*cells: int, threads: int = 1) -> tuple[list[NativeDynamics], Tensor, FlatAdam, Tensor]:
    """Members with so many hidden units each, their rows and targets, and Adam over all weights."""
    rng = torch.Generator().manual_seed(0)
    x, target = (torch.randn(16, numbers, generator=rng) for numbers in (7, 3))
    drawn = [
        Network(
            [torch.randn(*layer, generator=rng) / layer[0] ** 0.5 for layer in pairwise(sizes)],
            [torch.randn(outputs, generator=rng) / 10 for outputs in sizes[1:]],
        )
        for sizes in ((7, number, number, 6) for number in cells)
    ]
    parts = [part for one in drawn for part in chain(*zip(one.weights, one.biases))]
    weights = torch.nn.Parameter(torch.cat([part.reshape(-1) for part in parts]))
    weights.grad = torch.zeros_like(weights)
    own, gradients = (views(flat, parts) for flat in (weights.detach(), weights.grad))
    natives = []
    for at in range(0, len(parts), 6):
        one = Network(own[at : at + 6 : 2], own[at + 1 : at + 6 : 2])
        natives.append(
            NativeDynamics(one, gradients[at : at + 6], x, target, log_var_range=(-10.0, 0.5), threads=threads)
        )
    return natives, x, FlatAdam([weights], lr=1e-3), target


def test_a_member_that_updates_with_others_goes_on_alone() -> None:
    """They need more memory together."""
    members, x, adam, target = members_in_one_buffer(64, 64, 64, 64, threads=2)
    first = members[0](x, target)
    found = [dynamics_updates(members, x[None, None], target[None, None], adam.as_native())[0, 0] for _ in range(2)]
    assert torch.equal(found[0], first[0])
    assert members[0].call.struct.scratch is None  # what it computed in before is gone
    assert members[0](x, target) < found[1] < first
    assert 0 <= members[0].call.struct.scratch - members[0].call._scratch.data_ptr() < 64


def test_members_that_do_not_fit_together_are_refused() -> None:
    """Or they would compute in memory that is too small, and write beside the weights."""
    members, x, adam, target = members_in_one_buffer(8, 8, 8)
    rows = x[None, None], target[None, None]
    others, *_alive = members_in_one_buffer(8, 9)
    with pytest.raises(ValueError, match=r"batch, threads and layers \(16, 1, .* give them the same ones"):
        dynamics_updates([members[0], others[1]], *rows, adam.as_native())
    with pytest.raises(ValueError, match="a gradient lies outside of the flat buffer that the step of Adam reads"):
        dynamics_updates([members[0], others[0]], *rows, adam.as_native())
    with pytest.raises(ValueError, match="3 members are not those of 2 runs; give as many for each run"):
        dynamics_updates(
            members, x.expand(1, 2, -1, -1).contiguous(), target.expand(1, 2, -1, -1).contiguous(), adam.as_native()
        )
