"""What happens in Algorithm 1, as its caller hears of it.

Shapes: K runs, D design.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

Kind = Literal["first", "optimised", "random", "fixed"]


@dataclass(frozen=True)
class DesignChosen:
    """A body is about to be built.

    Attributes:
        index: 0 for the first.
        kind: one of the first designs, the optimum of Eq. 5, a random one, or the one body that is fixed throughout.
        design: ``[K, D]``.
        predicted: Eq. 5 at this design before anything is learnt on it, ``[K]``; None while there is no start state.
    """

    index: int
    kind: Kind
    design: Tensor
    predicted: Tensor | None


@dataclass(frozen=True)
class EpisodeDone:
    """One training episode, the updates after it, and one evaluation episode.

    Attributes:
        index: of the design.
        kind: of the design.
        episode: 0 for the design's first.
        design: ``[K, D]``.
        training_return: undiscounted, of the sampled actions, ``[K]``.
        evaluation_return: undiscounted, of the deterministic individual policy, ``[K]``.
        env_steps: training steps of one run so far; evaluation steps are not counted, nothing is learnt from them.
        imagined: rows in Replay_Art of one run.
        metrics: means over the updates, each ``[K]``: losses, entropies, ``model_error``.
        seconds: wall-clock by part; parts that run side by side overlap, ``episode`` is the whole.
    """

    index: int
    kind: Kind
    episode: int
    design: Tensor
    training_return: Tensor
    evaluation_return: Tensor
    env_steps: int
    imagined: int
    metrics: dict[str, Tensor]
    seconds: dict[str, float]


@dataclass(frozen=True)
class DesignDone:
    """All episodes of a design are over.

    Attributes:
        index: of the design.
        kind: of the design.
        design: ``[K, D]``.
        best_return: highest evaluation return, ``[K]``: the figure of merit of the paper's Fig. 1.
    """

    index: int
    kind: Kind
    design: Tensor
    best_return: Tensor


Event = DesignChosen | EpisodeDone | DesignDone
