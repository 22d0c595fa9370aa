"""Read the bounds of a design from a spec, for generators and searches.

Shapes: ``*B`` any batch, ``D`` design entries.
"""

from __future__ import annotations

from torch import Tensor
from torchrl.data import Bounded


def bounds_of(spec: Bounded) -> tuple[Tensor, Tensor]:
    """Return the lowest and the highest design of a spec, each ``[D]``."""
    space = getattr(spec, "space", None)  # a Composite has none
    if space is None or not hasattr(space, "low") or len(spec.shape) != 1:
        raise ValueError(f"{spec} is not the bounds of one design; pass env.design_spec, a Bounded of shape [D]")
    low, high = space.low, space.high
    if not bool(((low <= high) & low.isfinite() & high.isfinite() & (high - low).isfinite()).all()):
        raise ValueError(
            f"{low.tolist()} to {high.tolist()} are no bounds of a design: each must be finite, and low <= high"
        )
    return low, high


def bounds_for(design: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Return the bounds on the device and in the dtype of ``design``; refuse one of another length or whole numbers."""
    if design.shape[-1:] != low.shape:
        raise ValueError(
            f"a design of shape {list(design.shape)} does not have the {len(low)} entries of the design space; "
            f"pass [*B, {len(low)}]"
        )
    if not design.is_floating_point():  # whose bounds would be rounded to whole numbers
        raise ValueError(f"a design is {design.dtype}, it must be of floating-point numbers; pass design.float()")
    return low.to(design), high.to(design)


def in_unit_cube(design: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Where designs ``[*B, D]`` are between the bounds, 0 to 1 in each entry; 0 in one that is held fixed.

    Example:
        >>> import torch
        >>> in_unit_cube(torch.tensor([1.0, 1.2]), torch.tensor([0.5, 1.2]), torch.tensor([2.5, 1.2]))
        tensor([0.2500, 0.0000])
    """
    width = high - low
    return (design - low) / width.where(width > 0, 1)
