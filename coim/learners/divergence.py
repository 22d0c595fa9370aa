"""Runs whose learning has diverged: found, frozen, and kept away from all that comes after.

A run of K has diverged when one of its losses, weights or moments is no finite number any more. Its weights are put
back to what they were before that episode's updates, and after every later episode's too: it acts on, on the body that
it has, but learns nothing. So nothing that is not finite ever reaches a body, a replay, a dream or a search, every
random number is drawn as it would have been, and the other runs go on to the last bit as if it had not diverged.

Shapes: K runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import torch
from torch import Tensor

from coim.events import Place

# Far beyond any weight that has learnt something, and small enough that the outputs of finite weights are finite: four
# layers of 500 units multiply an input by less than (500 * 1e5)^4 = 6e30, and float32 ends at 3e38.
LARGEST_WEIGHT = 1e5


class Learner(Protocol):
    """What learning writes to, each tensor ``[K, ...]`` and a view of the learner's own."""

    def weights_by_run(self) -> list[Tensor]:
        """Weights, and targets if there are any."""

    def moments_by_run(self) -> list[Tensor]:
        """Of the optimiser; none before its first step."""


class Divergence:
    """Which runs have diverged and where, and what is done about it around each episode's updates.

    Args:
        num_runs: K.
        learners: all that learn.

    Attributes:
        places: the design and the episode of whose updates each diverged run did not survive, both from 0.
    """

    def __init__(self, num_runs: int, learners: Sequence[Learner]) -> None:
        self.num_runs, self.learners = num_runs, learners
        self.places: dict[int, Place] = {}
        self._good: list[Tensor] = []

    def remember(self) -> None:
        """Copy all weights before an episode's updates."""
        weights = self._weights()
        if self._good:
            torch._foreach_copy_(self._good, weights)
        else:
            self._good = [tensor.clone() for tensor in weights]

    def contain(self, metrics: Mapping[str, Tensor], place: Place) -> None:
        """Find the runs that have diverged in these updates, and put back what was remembered of all that ever have.

        Args:
            metrics: of these updates, ``[K]`` each.
            place: where that was.
        """
        sound = self._sound(metrics)
        for run in (~sound).nonzero().flatten().tolist():
            self.places.setdefault(run, place)
        for run in self.places:
            for tensor, good in zip(self._weights(), self._good, strict=True):
                tensor[run] = good[run]
            for learner in self.learners:
                for moment in learner.moments_by_run():
                    moment[run] = 0.0

    def frozen_before(self, place: Place) -> list[int]:
        """Runs that had diverged before an episode of a design; with episode 0, before the design began."""
        return [run for run, diverged in self.places.items() if diverged < place]

    def blank(self, values: Tensor, place: Place) -> Tensor:
        """The numbers of all runs, ``[K, ...]``, NaN where a run had diverged before."""
        frozen = self.frozen_before(place)
        if not frozen:
            return values
        values = values.clone()
        values[frozen] = torch.nan
        return values

    @property
    def everywhere(self) -> bool:
        """Whether no run is left that learns."""
        return len(self.places) == self.num_runs

    def _weights(self) -> list[Tensor]:
        return [tensor.detach() for learner in self.learners for tensor in learner.weights_by_run()]

    def _sound(self, metrics: Mapping[str, Tensor]) -> Tensor:
        """Which runs hold finite numbers alone, ``[K]`` bool on the CPU."""
        sound = torch.ones(self.num_runs, dtype=torch.bool, device="cpu")
        for value in metrics.values():
            sound &= value.isfinite().cpu()
        moments = [moment for learner in self.learners for moment in learner.moments_by_run()]
        for tensors, bound in ((self._weights(), LARGEST_WEIGHT), (moments, torch.inf)):
            if tensors:
                sound &= (torch.stack([_largest(tensor.flatten(1)) for tensor in tensors]).amax(0) < bound).cpu()
        return sound


def _largest(rows: Tensor) -> Tensor:
    """Largest absolute value of each row, NaN if there is one; twenty times faster than its norm, ``[K, N] -> [K]``."""
    return torch.maximum(rows.amax(1), -rows.amin(1))


def flat_fitness(designs: Tensor) -> Tensor:
    """Stand in for Eq. 5 of a run that needs no body; the search draws as many numbers for it, ``[P, D] -> [P]``."""
    return 0.0 * designs.sum(-1)
