"""Search for the next body not far from one that was built.

Shapes: ``P`` candidate designs, ``D`` design entries.

References:
    D. Eriksson et al., *Scalable Global Optimization via Local Bayesian Optimization*, 2019 (arXiv:1910.01739): a box
    around the best point so far.
"""

from __future__ import annotations

from torch import Tensor
from torchrl.data import Bounded

from .bounds import bounds_for, bounds_of, in_unit_cube
from .search import DesignSearch, Fitness


class TrustRegion:
    """Let a search look only at designs near one that was built, where its fitness is still to be trusted.

    The search itself goes on over the whole design space, with its random numbers: what it asks for is moved into a
    box around the centre.

    Args:
        spec: bounds of one design, ``[D]``, as ``env.design_spec``.
        search: that maximises over ``spec``, or over a part of it, which it does not leave here either.
        reach: half the length of the box, as a share of the range of each entry, in (0, 1].  The box ends where the
            design space does.

    Raises:
        ValueError: if ``spec`` is not one bounded design, or ``reach`` is not in (0, 1].

    Example:
        >>> import torch
        >>> from coim.designs import GradientSearch
        >>> spec = Bounded(low=0.0, high=2.0, shape=(2,))
        >>> region = TrustRegion(spec, GradientSearch(spec, seed=0), reach=0.25)
        >>> design, value = region.maximise(lambda designs: designs.sum(-1), centre=torch.tensor([0.5, 1.8]))
        >>> design
        tensor([1., 2.])
    """

    def __init__(self, spec: Bounded, search: DesignSearch, *, reach: float = 0.25) -> None:
        check_reach(reach)
        self._low, self._high = bounds_of(spec)
        self.search, self.reach = search, reach

    def maximise(self, fitness: Fitness, *, centre: Tensor) -> tuple[Tensor, float]:
        """Return the best design ``[D]`` found around ``centre``, ``[D]``, and its fitness.

        Raises:
            ValueError: if ``centre`` is not in the design space, and what the search raises.
        """
        bounds_for(centre, self._low, self._high)
        centre, low, high = centre.to(self._low), self._low, self._high
        if centre.dim() != 1 or not bool(((low <= centre) & (centre <= high)).all()):
            raise ValueError(
                f"the centre {centre.tolist()} is not a design between {low.tolist()} and {high.tolist()}; "
                "give one body that was built"
            )
        step = self.reach * (high - low)
        if (own := getattr(self.search, "spec", None)) is not None:
            low, high = bounds_for(centre, *bounds_of(own))
        start, end = (centre - step).clamp(low, high), (centre + step).clamp(low, high)

        def moved(designs: Tensor) -> Tensor:
            share = in_unit_cube(designs, low, high)
            return (start + share * (end - start)).clamp(start, end)

        found, value = self.search.maximise(lambda designs: fitness(moved(designs)))
        return moved(found), value


def check_reach(reach: float) -> None:
    """Refuse a box that is empty or longer than the design space."""
    if not 0 < reach <= 1:
        raise ValueError(f"reach is {reach}, it must be in (0, 1]: a share of the range of each entry")


def check_widening(widening: float, reach: float | None) -> None:
    """Refuse a box that shrinks, and a widening of no box."""
    if not 0 <= widening < float("inf"):
        raise ValueError(f"widening is {widening}, it must be 0 or more: a share of the range of each entry")
    if widening and reach is None:
        raise ValueError(f"widening is {widening} without a reach that it could widen; give one, such as reach=0.25")
