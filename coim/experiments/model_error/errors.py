"""Squared error of predicted next observations, raw and in units of what one step changes.

Shapes: R rows, K runs, E members, S observation, D design, A action.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Fig. 4(a).
"""

from __future__ import annotations

from typing import Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor

from coim.learners.dynamics import DynamicsLearner


class Model(Protocol):
    """A model to measure: a `coim.GaussianEnsemble`, or anything that predicts as it does."""

    def moments(self, observation: Tensor, action: Tensor, design: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of the next observation, each ``[R, K, E, S]``."""

    def wrapped(self, x: Tensor) -> Tensor:
        """Bring the angles among differences of observations into (-pi, pi]."""


def prediction_error(model: Model, rows: TensorDictBase) -> Tensor:
    """Predicted minus true next observation, ``[R, K, S]``.

    The prediction is the mean of the members' means, the least squared error that an ensemble offers. ``model_error``
    in a run's CSV files is larger: the mean error of single members, of which a dream draws one for each transition.

    Args:
        model: makes the predictions.
        rows: ``[R, K]`` transitions.
    """
    means, _ = model.moments(rows["observation"], rows["action"], rows["design"])
    # Averaged as differences, because the mean of two angles beside the cut at pi is on the other side.
    return model.wrapped(means - rows["next", "observation"].unsqueeze(-2)).mean(-2)


def persistence_error(model: Model, rows: TensorDictBase) -> Tensor:
    """Error of predicting that nothing changes, ``[R, K, S]``."""
    return model.wrapped(rows["observation"] - rows["next", "observation"])


def mean_squares(error: Tensor, variance: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Means of squared errors over rows and entries of the observation.

    Args:
        error: ``[R, K, S]``.
        variance: of one-step changes, entry by entry, ``[S]`` or ``[K, S]``.
        valid: rows that count, ``[R, K]`` bool.

    Returns:
        ``[K]`` twice: raw, as the paper prints it (m, rad, m/s and rad/s in one mean), and in units of ``variance``,
        where predicting that nothing changes scores about 1 on the rows that the variance is of. NaN where no row
        counts.

    Example:
        >>> error, valid = torch.tensor([[[1.0, 2.0]], [[9.0, 9.0]]]), torch.tensor([[True], [False]])
        >>> mean_squares(error, torch.tensor([1.0, 4.0]), valid)
        (tensor([2.5000]), tensor([1.]))
    """
    squares = error.square()
    raw, normalised = squares.mean(-1), (squares / variance.clamp(min=1e-12)).mean(-1)
    count = valid.sum(0)
    raw, normalised = (torch.where(valid, x, 0.0).sum(0) / count for x in (raw, normalised))
    return raw, normalised


def change_variance(learner: DynamicsLearner) -> Tensor:
    """Variance of one-step changes in all that a learner of changes has observed, ``[S]`` or ``[K, S]``.

    Raises:
        ValueError: if it learns the next observation itself, and so has statistics of states.
    """
    if learner.ensemble.predict != "delta":
        raise ValueError(f"predict={learner.ensemble.predict!r} keeps no statistics of changes; pass the other learner")
    return learner.ensemble.targets.std.square().float()
