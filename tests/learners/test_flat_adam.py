"""`FlatAdam` is `torch.optim.Adam` to the last bit, with its hooks and schedulers."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn
from torch.optim.optimizer import register_optimizer_step_post_hook, register_optimizer_step_pre_hook

from coim.learners.captured import FlatAdam


def pair(**settings: Any) -> list[torch.optim.Adam]:
    """The stock optimiser and ours, over weights of their own that are equal."""
    start = torch.randn(1000, generator=torch.Generator().manual_seed(0))
    return [make([nn.Parameter(start.clone())], fused=True, **settings) for make in (torch.optim.Adam, FlatAdam)]


def weights_of(optimiser: torch.optim.Adam) -> nn.Parameter:
    return optimiser.param_groups[0]["params"][0]


def step(optimiser: torch.optim.Adam, number: int) -> None:
    weights = weights_of(optimiser)
    weights.grad = torch.randn(weights.shape, generator=torch.Generator().manual_seed(number))
    optimiser.step()


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"lr": 0.1, "weight_decay": 1e-2},
        {"weight_decay": 0.5, "decoupled_weight_decay": True},
        {"amsgrad": True, "maximize": True},
        {"betas": (0.5, 0.7), "eps": 1e-3},
    ],
)
def test_the_bits_are_those_of_the_stock_optimiser(settings: dict[str, Any]) -> None:
    stock, ours = pair(**settings)
    for number in range(5):
        for optimiser in (stock, ours):
            optimiser.param_groups[0]["lr"] *= 0.9  # settings may change between steps
            step(optimiser, number)
    assert torch.equal(weights_of(stock), weights_of(ours))
    theirs, own = (optimiser.state[weights_of(optimiser)] for optimiser in (stock, ours))
    assert theirs.keys() == own.keys()
    assert all(torch.equal(theirs[name], own[name]) for name in own)


def test_hooks_are_called_and_schedulers_see_the_step() -> None:
    called = []
    for optimiser in pair():
        optimiser.register_step_pre_hook(lambda *_: called.append("before"))
        optimiser.register_step_post_hook(lambda *_: called.append("after"))
        scheduler = torch.optim.lr_scheduler.ExponentialLR(optimiser, 0.5)
        step(optimiser, 0)
        scheduler.step()  # warns, which is an error here, if it has seen no step
        assert optimiser.param_groups[0]["lr"] == 5e-4
    assert called == ["before", "after"] * 2


def test_hooks_of_all_optimisers_are_seen() -> None:
    _, ours = pair()
    assert isinstance(ours, FlatAdam)
    assert ours.is_plain()
    for register in (
        register_optimizer_step_pre_hook,
        register_optimizer_step_post_hook,
    ):
        hook = register(lambda *_: None)
        try:
            assert not ours.is_plain()
        finally:
            hook.remove()
    assert ours.is_plain()
