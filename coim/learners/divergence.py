"""Find runs whose learning has diverged, and freeze them.

A run of K has diverged when one of its losses, weights or moments is not finite any more. Its weights are put back to
what they were before the updates of that episode, and after each later episode again: the run keeps its body and acts,
but learns nothing. So only finite numbers reach a body, a replay, a dream or a search. Every random number is drawn as
it would have been, and the other runs go on, to the last bit, as if this one had not diverged.

Shapes: K runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from coim.events import Place
from coim.learners.flat_weights import FlatLearner

# Far beyond any weight that has learnt something, and small enough that the outputs of finite weights are finite: four
# layers of 500 units multiply an input by less than (500 * 1e5)^4 = 6e30, and float32 ends at 3e38.
LARGEST_WEIGHT = 1e5


class Divergence:
    """The runs that have diverged, and the weights that they are put back to.

    Args:
        num_runs: K.
        learners: all learners of the algorithm.

    Attributes:
        places: design and episode, both from 0, after which each diverged run was found.

    Example:
        >>> from coim import DynamicsLearner, GaussianEnsemble, HopperMorph
        >>> env = HopperMorph(num_runs=2, seed=0)
        >>> learner = DynamicsLearner(GaussianEnsemble.for_env(env, num_cells=(8,), num_runs=2), num_runs=2)
        >>> divergence = Divergence(2, [learner])
        >>> divergence.remember()
        >>> divergence.contain({"loss_dynamics": torch.tensor([0.5, torch.inf])}, (3, 0))
        >>> divergence.places
        {1: (3, 0)}
    """

    def __init__(self, num_runs: int, learners: Sequence[FlatLearner]) -> None:
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
        """Find the runs that diverged in these updates, and put back the weights of all that have diverged so far.

        Args:
            metrics: what the updates returned, ``[K]`` each.
            place: design and episode of these updates.
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
        """List the runs that had diverged before an episode of a design; with episode 0, before the design began."""
        return [run for run, diverged in self.places.items() if diverged < place]

    def blank(self, values: Tensor, place: Place) -> Tensor:
        """Return the numbers of all runs, ``[K, ...]``, with NaN where a run had diverged before."""
        frozen = self.frozen_before(place)
        if not frozen:
            return values
        values = values.clone()
        values[frozen] = torch.nan
        return values

    @property
    def everywhere(self) -> bool:
        """Whether all runs have diverged."""
        return len(self.places) == self.num_runs

    def _weights(self) -> list[Tensor]:
        return [tensor.detach() for learner in self.learners for tensor in learner.weights_by_run()]

    def _sound(self, metrics: Mapping[str, Tensor]) -> Tensor:
        """Tell for each run whether its numbers are finite and its weights small enough, ``[K]`` bool on the CPU."""
        sound = torch.ones(self.num_runs, dtype=torch.bool, device="cpu")
        for value in metrics.values():
            sound &= value.isfinite().cpu()
        moments = [moment for learner in self.learners for moment in learner.moments_by_run()]
        for tensors, bound in ((self._weights(), LARGEST_WEIGHT), (moments, torch.inf)):
            if tensors:
                sound &= (torch.stack([_largest(tensor.flatten(1)) for tensor in tensors]).amax(0) < bound).cpu()
        return sound


def _largest(rows: Tensor) -> Tensor:
    """Largest absolute value of each row, ``[K, N] -> [K]``, NaN if the row has one; 20 times faster than its norm."""
    return torch.maximum(rows.amax(1), -rows.amin(1))
