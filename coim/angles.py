"""Angles that do not wind up, for the bodies and for the model that learns from them.

Shapes: *B any batch.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def wrap_angle(angle: Tensor) -> Tensor:
    """Turn an angle back into (-pi, pi].

    The root's hinge is unbounded: a robot that rolls on the floor passes pi, and a cost on its angle would grow without
    end.

    Args:
        angle: in rad, ``[*B]``; inside the range it comes out unchanged, to the last bit.

    Returns:
        The same direction within (-pi, pi], ``[*B]``.

    Example:
        >>> wrap_angle(torch.tensor([0.5, 2 * math.pi + 0.5, -math.pi]))
        tensor([0.5000, 0.5000, 3.1416])
    """
    return angle.sub(torch.ceil(angle / math.tau - 0.5), alpha=math.tau)
