"""Pairs of a state and a body: which of them cannot be, and what is taken in their place.

Shapes: ``*B`` any batch, ``N`` rows, ``K`` runs, ``S`` state, ``D`` design.

References:
    Co-Imagination of Behaviour and Morphology of Agents: Eq. 5 and 7, a state under another design.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

StatesAre = Literal["stored", "matched"]
"""What a state is under another design: as it was stored (the paper's), or put under it by the body's transfer."""

# m. Contacts are soft: under random actions half of all states that touch the floor are 3 mm deep, 99 % less than 21 mm
# (hopper, cheetah) or 41 mm (walker), and a hard fall reaches 44 to 88 mm.
IN_THE_FLOOR = 0.05


def impossible_pairs(clearance: Callable[[Tensor, Tensor], Tensor], observation: Tensor, design: Tensor) -> Tensor:
    """Find states that a body cannot be in: more than `IN_THE_FLOOR` of it is below the floor.

    That is 5 cm for a robot of any size, as measured on robots with legs of half a metre to a metre: of one with legs
    of a few centimetres hardly any pair counts as impossible.

    Args:
        clearance: height in m of a body's lowest point above the floor, as :meth:`coim.MorphEnv.clearance`.
        observation: ``[*B, S]``.
        design: ``[*B, D]``.

    Returns:
        ``[*B]`` bool.

    Example:
        >>> from coim import HopperMorph
        >>> standing = torch.tensor([1.25] + [0.0] * 10).expand(2, -1)
        >>> impossible_pairs(HopperMorph().clearance, standing, torch.tensor([[1.0] * 4, [1.2] * 4]))
        tensor([False,  True])
    """
    return clearance(observation, design).squeeze(-1) < -IN_THE_FLOOR


def stand_ins(usable: Tensor) -> Tensor:
    """Choose for each row the row that is taken: itself if it is usable, and otherwise the next usable one of its run.

    Nothing is drawn, and no run depends on another one. Usable rows stand in for the others in turn.

    Args:
        usable: ``[N]`` or ``[N, K]`` bool.

    Returns:
        Numbers of rows, in the shape of ``usable``.

    Raises:
        ValueError: if a run has no usable row.

    Example:
        >>> stand_ins(torch.tensor([True, False, True, False, False]))
        tensor([0, 0, 2, 2, 0])
    """
    counts = usable.sum(0)
    if not counts.all():
        raise ValueError(f"none of the {len(usable)} rows of a run can be used; give more of them")
    order = (~usable).long().argsort(stable=True, dim=0)  # the usable ones first
    turn = ((~usable).cumsum(0) - 1).clamp(min=0) % counts
    rows = torch.arange(len(usable), device=usable.device).reshape(-1, *[1] * (usable.ndim - 1))
    return torch.where(usable, rows, order.gather(0, turn))
