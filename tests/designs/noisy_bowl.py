"""Bodies of a square design space whose returns are a noisy quadratic."""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.data import Bounded

LOW, HIGH = 0.5, 2.0


SPEC = Bounded(low=LOW, high=HIGH, shape=(2,), dtype=torch.float32)


TOP = torch.tensor([1.0, 1.6])


def bowl(designs: Tensor) -> Tensor:
    """Best at TOP, where it is 0."""
    return -(designs - TOP.to(designs)).square().sum(-1)


def built(number: int, seed: int = 0, *, entries: int = 2) -> Tensor:
    return LOW + (HIGH - LOW) * torch.rand(number, entries, generator=torch.Generator().manual_seed(seed))


def noise(number: int, deviation: float, seed: int = 1) -> Tensor:
    return deviation * torch.randn(number, generator=torch.Generator().manual_seed(seed))


def returns_of(designs: Tensor, deviation: float = 100.0) -> Tensor:
    return 1000 + 400 * bowl(designs) + noise(len(designs), deviation)
