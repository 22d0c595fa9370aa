"""Running statistics to standardise the inputs and targets of networks.

Shapes: ``B`` batch, ``K`` runs, ``F`` features.

References:
    Chan, Golub, LeVeque 1983, Algorithms for Computing the Sample Variance: the merge of two sets of rows.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Self

import torch
from torch import Tensor, nn


class RunningNormaliser(nn.Module):
    """Mean and standard deviation of all rows ever seen, feature by feature, in float64.

    ``.to`` moves it to another device, but always leaves it in float64: a count in bfloat16 could not go beyond 256.

    Args:
        num_features: ``F``.
        num_runs: ``K`` independent statistics, or None.
        min_std: lower bound of the standard deviation of each feature, ``[F]``; zero by default.

    Note:
        A feature with a standard deviation below a millionth (of its mean, if that is above 1) is centred but not
        scaled.

    Example:
        >>> normaliser = RunningNormaliser(2)
        >>> normaliser.update(torch.tensor([[0.0, 7.0], [4.0, 7.0]]))
        >>> normaliser(torch.tensor([6.0, 8.0]))
        tensor([2., 1.])
    """

    count: Tensor
    mean: Tensor
    square_sum: Tensor
    min_std: Tensor

    def __init__(self, num_features: int, *, num_runs: int | None = None, min_std: Tensor | None = None) -> None:
        super().__init__()
        self.num_runs = num_runs
        shape = (num_features,) if num_runs is None else (num_runs, num_features)
        self.register_buffer("count", torch.zeros((*shape[:-1], 1), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(shape, dtype=torch.float64))
        self.register_buffer("square_sum", torch.zeros(shape, dtype=torch.float64))
        floor = torch.zeros(num_features) if min_std is None else min_std
        self.register_buffer("min_std", floor.to(self.mean).expand(shape).clone())

    @property
    def std(self) -> Tensor:
        """Standard deviation of each feature, ``[(K,) F]``; 1 for features without data or without variation."""
        std = (self.square_sum / self.count.clamp(min=1)).sqrt()
        varied = std > 1e-6 * self.mean.abs().clamp(min=1)
        return torch.where(varied | (self.min_std > 0), std.maximum(self.min_std), torch.ones_like(std))

    @torch.no_grad()
    def update(self, rows: Tensor) -> None:
        """Merge rows into the statistics, in place.

        Args:
            rows: ``[*B, (K,) F]``, any number of them.

        Raises:
            ValueError: if the shape does not end in ``[(K,) F]``: rows would be counted for the wrong run. Or if a
                number is NaN or infinite, which the statistics would be from then on.
        """
        if rows.shape[-self.mean.ndim :] != self.mean.shape:
            raise ValueError(f"rows of shape {list(rows.shape)} must end in {list(self.mean.shape)}")
        rows = rows.to(self.mean.dtype).reshape(-1, *self.mean.shape)
        if not len(rows):
            return
        if not (finite := rows.isfinite()).all():
            row, *_, feature = (~finite).nonzero()[0].tolist()
            found = rows[~finite][0].item()
            raise ValueError(f"row {row} has {found} as feature {feature}; drop such rows")
        batch_mean = rows.mean(0)
        shift, total = batch_mean - self.mean, self.count + len(rows)
        self.square_sum += (rows - batch_mean).square().sum(0) + shift.square() * self.count * len(rows) / total
        self.mean += shift * len(rows) / total
        self.count.copy_(total)

    def forward(self, x: Tensor) -> Tensor:
        """Standardise ``[*B, (K,) F]``, in the dtype of ``x``."""
        return (x - self.mean.to(x.dtype)) / self.std.to(x.dtype)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move to another device, but keep the dtype."""
        for name, statistics in list(self.named_buffers()):
            moved = fn(statistics)
            self.register_buffer(name, moved if moved.dtype == statistics.dtype else statistics.to(moved.device))
        return self

    def keep_run(self, run: int) -> None:
        """Keep one run only, in place; see :func:`~coim.models.select_run`."""
        for name, buffer in list(self.named_buffers()):
            setattr(self, name, buffer[run].clone())
        self.num_runs = None
