"""A design search of your own: a class with one method, handed to Algorithm 1.

The search here is the cross-entropy method: draw designs from a Gaussian, keep the best ones, fit the Gaussian to them.
It needs no gradient of the critics, and far fewer designs than the swarm.

References:
    Rubinstein 1999, The cross-entropy method for combinatorial and continuous optimization, Methodology and Computing
    in Applied Probability 1.
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Eq. 5 (what is maximised).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Bounded

from recipes import algorithm1


class CrossEntropy:
    """The cross-entropy method within the bounds of a design; a `coim.DesignSearch`.

    Args:
        spec: bounds of one design, ``[D]``, as ``env.design_spec``.
        num_candidates: P, designs drawn in each iteration.
        num_elites: the best of them, to which the Gaussian is fitted; at least 2.
        num_iterations: how often.
        seed: of the draws.

    Example:
        >>> search = CrossEntropy(Bounded(low=0.5, high=2.0, shape=(2,)), seed=0)
        >>> design, value = search.maximise(lambda designs: -(designs - 1.5).square().sum(-1))
        >>> design.round(decimals=2), round(value, 3)
        (tensor([1.5000, 1.5000]), -0.0)
    """

    def __init__(
        self,
        spec: Bounded,
        *,
        num_candidates: int = 200,
        num_elites: int = 20,
        num_iterations: int = 20,
        seed: int = 0,
    ) -> None:
        self.spec = spec
        self.num_candidates, self.num_elites, self.num_iterations = num_candidates, num_elites, num_iterations
        self.rng = torch.Generator().manual_seed(seed)

    @torch.no_grad()
    def maximise(self, fitness: Callable[[Tensor], Tensor]) -> tuple[Tensor, float]:
        """Return the best design drawn, ``[D]``, and its fitness; ``fitness`` maps ``[P, D]`` to ``[P]``."""
        low, high = self.spec.space.low, self.spec.space.high
        mean, spread = (low + high) / 2, (high - low) / 2
        best, best_value = mean, -torch.inf
        for _ in range(self.num_iterations):
            noise = torch.randn(self.num_candidates, len(mean), generator=self.rng).to(mean)
            designs = (mean + spread * noise).clamp(low, high)
            values, order = fitness(designs).sort(descending=True)
            elites = designs[order[: self.num_elites]]
            mean, spread = elites.mean(0), elites.std(0)
            if values[0] > best_value:
                best, best_value = elites[0], values[0].item()
        return best, best_value

    # A run that is stopped and resumed goes on with the same draws if it can save them.
    def state_dict(self) -> dict[str, Tensor]:
        """Return the state of the draws."""
        return {"rng": self.rng.get_state()}

    def load_state_dict(self, state_dict: dict[str, Tensor]) -> None:
        """Go on with the draws of `state_dict`."""
        self.rng.set_state(state_dict["rng"])


def main(
    *,
    num_designs: int = 8,
    first_episodes: int = 1,
    episodes: int = 2,
    individual_updates: int = 250,
    seed: int = 0,
    **settings: Any,
) -> list[float]:
    """Run Algorithm 1 on the hopper with this search, a few episodes; returns the best return on each design.

    ``settings`` are others of `recipes.algorithm1.main`. `coim.CoAdaptation` takes the search as ``search``.
    """
    return algorithm1.main(
        make_search=functools.partial(CrossEntropy, seed=seed),
        num_designs=num_designs,
        first_episodes=first_episodes,
        episodes=episodes,
        individual_updates=individual_updates,
        seed=seed,
        **settings,
    )


if __name__ == "__main__":
    main()
