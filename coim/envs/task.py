"""What the tasks of all bodies have in common: a direction, and an angle that does not wind up.

Shapes: *B any batch.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

Task = Literal["forward", "backward"]


def speed_along(task: Task, velocity: Tensor) -> Tensor:
    """The horizontal speed that a task pays for: its sign is turned for walking backward (Fig. 1, second row).

    Args:
        task: ``"forward"`` or ``"backward"``.
        velocity: of the root along x in m/s, ``[*B]``.

    Returns:
        Speed in the task's direction in m/s, ``[*B]``.

    Raises:
        ValueError: the task is neither.

    Example:
        >>> speed_along("backward", torch.tensor([2.0]))
        tensor([-2.])
    """
    if task == "forward":
        return velocity
    if task == "backward":
        return -velocity
    raise ValueError(f"unknown task {task!r}; choose 'forward' or 'backward'")


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
