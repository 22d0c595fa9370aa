"""Generators G: the designs of imagined rows.

Shapes: ``*B`` any batch, ``D`` design entries.

References:
    Co-Imagination of Behaviour and Morphology of Agents: Eq. 7-8 and Sec. 5 (the three G), Sec. 6.3-6.4.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor
from torchrl.data import Bounded

from .bounds import bounds_for, bounds_of


class DesignGenerator(Protocol):
    """A generator G of Eq. 7-8: :func:`coim.imagine` gets the designs of imagined rows from it.

    Example:
        >>> class Taller:
        ...     def __call__(self, design, *, rng=None):
        ...         return (1.1 * design).clamp(0.5, 2.0)
        >>> Taller()(torch.tensor([[1.0, 1.9]]))
        tensor([[1.1000, 2.0000]])
    """

    def __call__(self, design: Tensor, *, rng: torch.Generator | None = None) -> Tensor:
        """Return the designs ``[*B, D]`` to imagine, given the designs ``[*B, D]`` of the stored rows."""


class KnownDesigns:
    """G(xi) = xi: every row keeps its stored design (Sec. 6.3).

    Example:
        >>> KnownDesigns()(torch.tensor([[1.0, 1.5]]))
        tensor([[1.0000, 1.5000]])
    """

    def __call__(self, design: Tensor, *, rng: torch.Generator | None = None) -> Tensor:
        """Return ``design`` itself, ``[*B, D]``; nothing is drawn."""
        return design


class NoisyDesigns:
    """G(xi) = N(xi, sigma^2), clipped to the bounds (Sec. 6.4).

    The paper does not say what happens to a draw outside of the bounds. Here each entry is clipped.

    Args:
        spec: bounds of one design, ``[D]``, as ``env.design_spec``.
        sigma: standard deviation, the same for every entry, in units of the scale factors.

    Raises:
        ValueError: if ``spec`` is not one bounded design, or ``sigma`` is negative.

    Example:
        >>> spec = Bounded(low=0.8, high=2.0, shape=(2,))
        >>> NoisyDesigns(spec, sigma=0.0)(torch.tensor([[1.0, 3.0]]))
        tensor([[1., 2.]])
    """

    def __init__(self, spec: Bounded, *, sigma: float = 0.1) -> None:
        if not sigma >= 0.0:
            raise ValueError(f"sigma is {sigma}, but a standard deviation is 0 or more; KnownDesigns() adds no noise")
        self._low, self._high = bounds_of(spec)
        self.sigma = sigma

    def __call__(self, design: Tensor, *, rng: torch.Generator | None = None) -> Tensor:
        """Return a noisy copy of ``design``, ``[*B, D]``, drawn with ``rng`` (default: torch's global generator)."""
        low, high = bounds_for(design, self._low, self._high)
        noise = torch.randn(design.shape, generator=rng, dtype=design.dtype, device=design.device)
        return (design + self.sigma * noise).clamp(low, high)


class RandomDesigns:
    """G(xi) = uniform(Xi): every row gets a new design from the whole design space (Sec. 6.4).

    It is also the exploration step of Algorithm 1.

    Args:
        spec: bounds of one design, ``[D]``, as ``env.design_spec``.

    Raises:
        ValueError: if ``spec`` is not one bounded design.

    Example:
        >>> spec = Bounded(low=0.8, high=2.0, shape=(2,))
        >>> spec.is_in(RandomDesigns(spec)(torch.ones(2)))
        tensor(True)
    """

    def __init__(self, spec: Bounded) -> None:
        self._low, self._high = bounds_of(spec)

    def __call__(self, design: Tensor, *, rng: torch.Generator | None = None) -> Tensor:
        """Return uniform designs of ``design``'s shape ``[*B, D]``, drawn with ``rng`` (default: the global one)."""
        low, high = bounds_for(design, self._low, self._high)
        uniform = torch.rand(design.shape, generator=rng, dtype=design.dtype, device=design.device)
        # low + (high - low) * u can round to just above high.
        return torch.minimum(low + (high - low) * uniform, high)
