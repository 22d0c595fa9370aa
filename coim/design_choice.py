"""The second loop of Algorithm 1: which body comes next.

Shapes: K runs, D design.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Algorithm 1 and Eq. 5.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from coim.designs import RandomDesigns
from coim.designs.search import Fitness
from coim.events import Kind
from coim.learners.divergence import flat_fitness
from coim.models.stacked import select_run
from coim.objectives.design import DesignValue

if TYPE_CHECKING:
    from coim.coadaptation import CoAdaptation


def next_trial(algorithm: CoAdaptation) -> Trial:
    """The next body of every run, before anything was learnt on it; a run that has diverged keeps the body that it has.

    Args:
        algorithm: between two bodies; its search and its generator of random designs move on.
    """
    kind, design, predicted = _next_design(algorithm)
    frozen = [*algorithm.divergence.places]
    if frozen:
        design = design.clone()
        design[frozen] = algorithm.buffers.ind[0]["design"][frozen].to(design.device)
        predicted = None if predicted is None else algorithm.divergence.blank(predicted, (algorithm.index, 0))
    best = torch.full(algorithm.env.batch_size, -torch.inf, dtype=torch.float32, device="cpu")
    return Trial(kind, design, predicted, best=best)


def _next_design(algorithm: CoAdaptation) -> tuple[Kind, Tensor, Tensor | None]:
    """First designs in order, then the optimum of Eq. 5 and a random design in turn; see ``bodies``."""
    first = algorithm.first_designs
    runs = algorithm.env.batch_size.numel()
    since = algorithm.index - len(first)
    if algorithm.bodies == "fixed":
        design = first[0].expand(runs, -1)
        return "fixed", design, _predict(algorithm, design)
    if since < 0:
        design = first[algorithm.index].expand(runs, -1)
        return "first", design, _predict(algorithm, design)
    if algorithm.bodies == "search" and since % 2 == 0:
        found = [algorithm.search.maximise(fitness) for fitness in _fitness(algorithm)]
        values = torch.tensor([value for _, value in found], dtype=torch.float32, device="cpu")
        return "optimised", torch.stack([design for design, _ in found]), values
    draw = RandomDesigns(algorithm.env.design_spec)
    design = draw(first[:1].cpu().expand(runs, -1), rng=algorithm.rngs["designs"]).to(first.device)
    return "random", design, _predict(algorithm, design)


def _fitness(algorithm: CoAdaptation) -> list[Fitness]:
    """Eq. 5 of each run, over the same draw of states; a run that has diverged has none to climb."""
    buffers = algorithm.buffers
    source = buffers.s0 if algorithm.value_over == "start" else buffers.pop
    states = source.sample(algorithm.num_start_states).to(algorithm.device)
    policy, qvalue = algorithm.population.policy, algorithm.population.qvalue
    value = functools.partial(
        DesignValue,
        precision=algorithm.precision,
        start_states_are=algorithm.value_states,
        env=algorithm.env,
    )
    runs = algorithm.env.batch_size.numel()
    if policy.num_runs is None:
        return [value(policy, qvalue, states[:, 0])]
    return [
        value(select_run(policy, k), select_run(qvalue, k), states[:, k])
        if k not in algorithm.divergence.places
        else flat_fitness
        for k in range(runs)
    ]


def _predict(algorithm: CoAdaptation, design: Tensor) -> Tensor | None:
    """Eq. 5 of a design that was not searched for, ``[K]`` on the CPU; None before there is a start state."""
    if len(algorithm.buffers.s0) == 0:
        return None
    return torch.stack([fitness(row.unsqueeze(0))[0] for fitness, row in zip(_fitness(algorithm), design)]).cpu()


@dataclass
class Trial:
    """A body that is being tried: where the algorithm stands between two of its events.

    Attributes:
        kind: of the design.
        design: ``[K, D]``.
        predicted: Eq. 5 at this design when it was chosen, ``[K]`` on the CPU, or None.
        best: highest evaluation return so far, ``[K]`` on the CPU; -inf of a run that has none, as one that
            has diverged before.
        next_episode: episodes that are over; with 0 the individual learner has not started yet.
    """

    kind: Kind
    design: Tensor
    predicted: Tensor | None
    best: Tensor
    next_episode: int = 0
