"""How much a longer or shorter part would gain, by the critics and by the returns of the bodies built so far.

Shapes: D design, C critics, W walks, n states of a walk.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy import stats
from tensordict import TensorDict
from torch import Tensor

from coim.designs.posterior import DesignPosterior
from coim.envs import MorphEnv
from coim.experiments.atlas.walkers import Walk
from coim.experiments.predictions import LEVEL
from coim.objectives import DesignValue
from coim.saved_run import Agent

STEP = 0.1  # share of a length by which it is changed


@dataclass(frozen=True)
class Gain:
    """Change of a body's return if one of its lengths grows by a tenth, and the 90 % interval around it.

    Attributes:
        value: slope of the return times a tenth of the length.
        low: lower end.
        high: upper end.
    """

    value: float
    low: float
    high: float

    @property
    def is_clear(self) -> bool:
        """Whether the interval leaves no doubt about the sign."""
        return self.low > 0 or self.high < 0


def gains_by_returns(
    bodies: MorphEnv, agent: Agent, walks: Sequence[Walk], designs: Tensor, returns: Tensor, best: Tensor
) -> list[Gain]:
    """Gain of each length at the best body by `DesignPosterior` over the best returns, with Eq. 5 as its prior.

    The critics count as far as they have ranked the bodies tried, and no further.

    Args:
        bodies: a fleet of one.
        agent: the population's networks.
        walks: at least one; Eq. 5 is taken over the states that they visited.
        designs: tried so far in the order of building, ``[N, D]``.
        returns: the best of each, ``[N]``.
        best: the body that is changed, ``[D]``.

    Raises:
        ValueError: as `DesignPosterior`, such as for less than three returns.
    """
    moves = bodies.root.height is not None
    states = TensorDict(
        {
            "observation": torch.cat([walk.observation for walk in walks]),
            "design": torch.cat([walk.design.float().expand(len(walk.observation), -1) for walk in walks]),
        },
        [sum(len(walk.observation) for walk in walks)],
    )
    value = DesignValue(
        agent.policy,
        agent.qvalue,
        states,
        start_states_are="matched" if moves else "stored",
        env=bodies if moves else None,
    )
    posterior = DesignPosterior(bodies.design_spec, designs.float(), returns, prior=value)
    shorter, longer = _neighbours(bodies, best)
    mean, deviation = posterior.difference(longer.float(), shorter.float())
    share = STEP * best / (longer - shorter).diagonal()
    half = stats.norm.ppf((1 + LEVEL) / 2) * deviation * share
    mean = mean * share
    return [Gain(*map(float, entry)) for entry in zip(mean, mean - half, mean + half)]


def gains_by_critics(
    bodies: MorphEnv, agent: Agent, walks: Sequence[Walk], best: Tensor, *, gamma: float
) -> list[Gain]:
    """Gain of each length at the best body by the gradient of each critic over visited states.

    The discounted value is read as reward per step, ``(1 - gamma) Q``, times the steps of an episode.

    Args:
        bodies: a fleet of one.
        agent: the population's networks.
        walks: at least one.
        best: the body that is changed, ``[D]``.
        gamma: the discount.

    Returns:
        The mean over critics and walks, and an interval that reaches from the lowest to the highest end of each
        critic's own 90 % interval over walks.
    """
    slopes = torch.stack([_slopes(bodies, agent, walk, best) for walk in walks])  # [W, C, D]
    slopes = slopes * (1 - gamma) * bodies.episode_steps * STEP * best
    mean = slopes.mean(0)
    error = slopes.std(0) / math.sqrt(len(walks)) if len(walks) > 1 else torch.zeros_like(mean)
    half = float(stats.t.ppf((1 + LEVEL) / 2, max(1, len(walks) - 1))) * error
    ends = (mean.mean(0), (mean - half).amin(0), (mean + half).amax(0))
    return [Gain(*map(float, entry)) for entry in zip(*ends)]


def in_words(gains: Sequence[Gain], names: Sequence[str], bodies: MorphEnv, best: Tensor) -> str:
    """A sentence on the length that would gain most, of those that may still move in that direction."""
    low, high = bodies.design_bounds()
    free = [
        i for i, gain in enumerate(gains)
        if (best[i] < high[i] - 1e-6 if gain.value > 0 else best[i] > low[i] + 1e-6)
    ]  # fmt: skip
    if not free:
        return "every length is at the bound at which it gains most"
    first = max(free, key=lambda i: abs(gains[i].value))
    gain = gains[first]
    sign = 1 if gain.value >= 0 else -1
    ends = sorted((sign * gain.low, sign * gain.high))
    clear = "" if gain.is_clear else "; the interval has 0 in it, so that no direction is certain"
    bound = [name for i, name in enumerate(names) if i not in free]
    left_out = f"; at its bound already: {', '.join(bound)}" if bound else ""
    return (
        f"a {names[first]} {'longer' if sign > 0 else 'shorter'} by a tenth would gain most: {sign * gain.value:+.3g} "
        f"({ends[0]:+.3g} to {ends[1]:+.3g}){clear}{left_out}"
    )


def _neighbours(bodies: MorphEnv, best: Tensor) -> tuple[Tensor, Tensor]:
    """The body with each length a tenth shorter, and longer, as far as the bounds allow: ``[D, D]`` each."""
    low, high = (bound.to(best) for bound in bodies.design_bounds())
    change = torch.diag(STEP * best)
    return torch.maximum(best - change, low), torch.minimum(best + change, high)


def _slopes(bodies: MorphEnv, agent: Agent, walk: Walk, best: Tensor) -> Tensor:
    """Gradient of the mean value of a walk's states with respect to the design, of each critic, ``[C, D]``."""
    design = best.float().clone().requires_grad_()
    observation = walk.observation
    if bodies.root.height is not None:
        observation = bodies.transfer(observation, walk.design.float(), design)
    own = design.expand(len(observation), -1)
    values = agent.qvalue.values(observation, agent.policy.deterministic_action(observation, own), own).mean(0)
    return torch.stack([torch.autograd.grad(value, design, retain_graph=True)[0] for value in values])
