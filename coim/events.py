"""What happens in Algorithm 1, as its caller hears of it.

Shapes: K runs, D design.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from torch import Tensor

Kind = Literal["first", "optimised", "random", "fixed"]
Place = tuple[int, int]
"""A design and one of its episodes, both from 0."""


@dataclass(frozen=True)
class DesignChosen:
    """A body is about to be built.

    Attributes:
        index: 0 for the first.
        kind: one of the first designs, the optimum of Eq. 5, a random one, or the one body that is fixed throughout.
        design: ``[K, D]``.
        predicted: Eq. 5 at this design before anything is learnt on it, ``[K]``; None while there is no start state.
        diverged: runs that have diverged, and where (see `coim.learners.divergence`). They keep the body that they
            have, and their numbers here and in all later events are NaN.
        expected: best return that is expected of this design, ``[K]``; None where a choice expects none.
        deviation: of the best return around ``expected``, noise of a run included, ``[K]``.

    Example:
        >>> import torch
        >>> event = DesignChosen(5, "optimised", torch.ones(2, 4), predicted=torch.tensor([31.5, 30.25]))
        >>> event.index, event.kind, event.predicted.tolist(), event.expected is None
        (5, 'optimised', [31.5, 30.25], True)
    """

    index: int
    kind: Kind
    design: Tensor
    predicted: Tensor | None
    diverged: Mapping[int, Place] = field(default_factory=dict)
    expected: Tensor | None = None
    deviation: Tensor | None = None


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
        metrics: means over the updates, each ``[K]``: losses, entropies; ``model_error``, the share of ``impossible``
            pairs among those imagined, the ``imagined_share`` of a batch if it is governed, the population's or the
            individual's, whichever has more, and how often the simulation has ``broken`` in the two episodes.
        seconds: wall-clock by part; parts that run side by side overlap, ``episode`` is the whole.
        diverged: runs that have diverged, and where. One that diverges in this very episode has its losses in
            ``metrics`` as they came out, and is evaluated with the weights that it had before.

    Example:
        To watch `CoAdaptation` learn, episode by episode:

        >>> import torch
        >>> def told(event: Event) -> None:
        ...     if isinstance(event, EpisodeDone):
        ...         print(event.index, event.episode, event.evaluation_return.tolist())
        >>> earned = torch.tensor([120.0, 80.0])
        >>> told(EpisodeDone(0, "first", 3, torch.ones(2, 4), 0.5 * earned, earned, 4000, 0, {}, {"episode": 4.1}))
        0 3 [120.0, 80.0]
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
    diverged: Mapping[int, Place] = field(default_factory=dict)


@dataclass(frozen=True)
class DesignDone:
    """All episodes of a design are over.

    Attributes:
        index: of the design.
        kind: of the design.
        design: ``[K, D]``.
        best_return: highest evaluation return, ``[K]``: the figure of merit of the paper's Fig. 1.
        diverged: runs that have diverged, and where; on this design, ``best_return`` is the highest until then.

    Example:
        >>> import torch
        >>> done = DesignDone(5, "optimised", torch.ones(2, 4), best_return=torch.tensor([910.0, 1240.0]))
        >>> int(done.best_return.argmax())  # the run whose body earned most
        1
    """

    index: int
    kind: Kind
    design: Tensor
    best_return: Tensor
    diverged: Mapping[int, Place] = field(default_factory=dict)


Event = DesignChosen | EpisodeDone | DesignDone


def running(event: Event) -> list[int]:
    """Runs that an event tells of: all but those that had diverged before the design, or before the episode."""
    place = (event.index, event.episode if isinstance(event, EpisodeDone) else 0)
    return [run for run in range(len(event.design)) if event.diverged.get(run, place) >= place]
