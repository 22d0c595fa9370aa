"""The next body by what the bodies built so far have earned.

Shapes: K runs, D design.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Algorithm 1 and Eq. 5.

    A. Cully, J. Clune, D. Tarapore and J.-B. Mouret, *Robots that can adapt like animals*, Nature 521, 2015.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchrl.data import Bounded

from coim.design_choice import DesignChoice, Situation
from coim.designs.posterior import LEAST_RETURNS, DesignPosterior
from coim.designs.search import Fitness


class PosteriorChoice(DesignChoice):
    """The first designs in order, then the optimum of a posterior over returns and a random design in turn.

    Each run has a Gaussian process of its own, fitted anew for every body to the best returns of the bodies that the
    run has tried. While fewer than three of them differ, Eq. 5 is maximised instead.

    Args:
        spec: bounds of one design, ``[D]``, as ``env.design_spec``.
        first_designs: ``[I, D]`` bodies that every run tries first, or ``[I, K, D]``.
        critic: whether Eq. 5 is the mean of the process, as far as it ranks the bodies tried; without it this is plain
            Bayesian optimisation of returns.
        others: keywords of `DesignChoice`. ``value_states="matched"`` and ``value_over="visited"`` give a critic that
            can rank bodies.

    Raises:
        ImportError: when this module is imported and BoTorch is not installed: ``pip install 'coim[posterior]'``.
        ValueError: as `DesignChoice`.

    Example:
        >>> from coim import GradientSearch, HopperMorph
        >>> spec = HopperMorph(seed=0).design_spec
        >>> choice = PosteriorChoice(spec, torch.ones(1, 4), search=GradientSearch(spec, seed=0), seed=0)
        >>> choice.critic
        True
    """

    def __init__(self, spec: Bounded, first_designs: Tensor, *, critic: bool = True, **others: Any) -> None:
        super().__init__(spec, first_designs, **others)
        self.critic = critic

    def objectives(self, situation: Situation, values: list[Fitness]) -> list[Fitness]:
        """The posterior of each run, or Eq. 5 where too few returns are known or the run has diverged."""
        return [
            value if run in situation.diverged else self._posterior(situation, run, value) or value
            for run, value in enumerate(values)
        ]

    def expect(self, objectives: list[Fitness], design: Tensor) -> tuple[Tensor, Tensor] | None:
        """Mean and deviation of the best return by each run's posterior; NaN for a run that has none yet."""
        if not any(isinstance(objective, DesignPosterior) for objective in objectives):
            return None
        both = torch.full((2, len(design)), torch.nan, device="cpu")
        for run, objective in enumerate(objectives):
            if isinstance(objective, DesignPosterior):
                both[:, run] = torch.cat(objective.predict(design[run : run + 1])).cpu()
        return both[0], both[1]

    def _posterior(self, situation: Situation, run: int, value: Fitness) -> DesignPosterior | None:
        if not situation.tried:
            return None
        returns = torch.stack([done.best_return[run].cpu() for done in situation.tried])
        known = returns[returns.isfinite()]
        if len(known) < LEAST_RETURNS or bool((known == known[0]).all()):
            return None
        designs = torch.stack([done.design[run] for done in situation.tried])
        return DesignPosterior(self.spec, designs, returns, prior=value if self.critic else None)
