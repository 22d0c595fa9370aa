"""The tasks of all bodies: walking forward or backward.

Shapes: *B any batch.
"""

from __future__ import annotations

from typing import Literal

from torch import Tensor

Task = Literal["forward", "backward"]


def speed_along(task: Task, velocity: Tensor) -> Tensor:
    """Return the horizontal speed in the direction of a task; backward is Fig. 1, second row.

    Args:
        task: ``"forward"`` or ``"backward"``.
        velocity: velocity of the root along x in m/s, ``[*B]``.

    Returns:
        Speed in the task's direction in m/s, ``[*B]``.

    Raises:
        ValueError: if the task is neither.

    Example:
        >>> import torch
        >>> speed_along("backward", torch.tensor([2.0]))
        tensor([-2.])
    """
    if task == "forward":
        return velocity
    if task == "backward":
        return -velocity
    raise ValueError(f"unknown task {task!r}; choose 'forward' or 'backward'")
