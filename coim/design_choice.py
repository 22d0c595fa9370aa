"""The second loop of Algorithm 1: which body comes next.

Shapes: I first designs, K runs, D design.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Algorithm 1 and Eq. 5.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor
from torchrl.data import Bounded

from coim.agreement import check_counts, check_transfer, check_words
from coim.buffers import Buffers
from coim.designs import DesignSearch, RandomDesigns, TrustRegion
from coim.designs.search import Fitness
from coim.designs.trust_region import check_reach, check_widening
from coim.envs.morph import MorphEnv
from coim.events import DesignChosen, DesignDone, Kind, Place
from coim.learners.sac import SACLearner
from coim.models.stacked import select_run
from coim.objectives.design import DesignValue
from coim.pairs import StatesAre
from coim.randomness import restore_generator, stream


@dataclass(frozen=True)
class Situation:
    """Everything that the choice of a body may depend on, read between two bodies.

    Attributes:
        index: of the design to choose, from 0.
        env: the bodies.
        population: learner that has seen all designs so far.
        buffers: rows of all designs so far; ``s0`` has their start states, ``pop`` every state that was visited.
        tried: designs whose episodes are over, in the order of building, each with its kind and its best return
            ``[K]``. A run that was begun before they were kept lacks its earlier ones.
        diverged: runs that have diverged, and where. They need no new body.

    Example:
        A choice that explores around each run's best body so far, where Algorithm 1 draws one from all:

        >>> class NearTheBest(DesignChoice):
        ...     def explore(self, situation: Situation) -> Tensor:
        ...         returns = torch.stack([done.best_return for done in situation.tried])  # [N, K]
        ...         designs = torch.stack([done.design for done in situation.tried])  # [N, K, D]
        ...         best = designs[returns.nan_to_num(nan=-torch.inf).argmax(0), torch.arange(situation.num_runs)]
        ...         return self.spec.project(best + 0.1 * torch.randn(best.shape, generator=self.rng))
    """

    index: int
    env: MorphEnv
    population: SACLearner
    buffers: Buffers
    tried: Sequence[DesignDone]
    diverged: Mapping[int, Place]

    @property
    def num_runs(self) -> int:
        """K."""
        return self.buffers.s0.num_runs

    @property
    def present(self) -> Tensor:
        """Bodies that the runs have now, ``[K, D]``; there are none before the first episode."""
        return self.buffers.ind[0]["design"]


class DesignChoice:
    """Algorithm 1's choice: the first designs in order, then the optimum of Eq. 5 and a random design in turn.

    Another way of choosing is a subclass. `objectives` says what the search maximises, `explore` what is tried in
    between; both may read the whole `Situation`. What they draw or learn belongs into `state_dict`.

    Args:
        spec: bounds of one design, ``[D]``, as ``env.design_spec``.
        first_designs: ``[I, D]`` bodies that every run tries first, on the device of the bodies; ``[I, K, D]`` gives
            each run bodies of its own.
        search: maximises Eq. 5; needed if ``bodies`` is ``"search"``.
        bodies: which come after the first ones. ``"search"`` is Algorithm 1, ``"random"`` never searches. ``"fixed"``
            takes the first of the first designs every time, from the start on: the same budget for one body.
        num_start_states: n, states that Eq. 5 averages over.
        value_states: what they are under the query: ``"stored"`` (the paper's) or ``"matched"``; see
            `coim.DesignValue`.
        value_over: where they come from: the ``"start"`` of episodes (the paper's), or all that were ``"visited"`` so
            far, a draw of Replay_Pop.
        reach: search only around the body with the best return so far, this share of each entry's range to both sides,
            in (0, 1]; None searches everywhere. See `coim.designs.TrustRegion`.
        widening: what is added to ``reach`` for each body after the first ones, at least 0: the more is known, the
            further away the next body may be.
        precision: of the networks' products in Eq. 5.
        seed: seeds the random designs. It may be the algorithm's own: their numbers are independent of all others'.

    Raises:
        ValueError: if a word such as ``bodies`` is unknown, ``num_start_states`` is below 1, ``reach`` is not in
            (0, 1], ``widening`` is negative or without a reach, first designs have the wrong shape, dtype or device,
            or they or the search leave the bounds.
        TypeError: if the search has no method ``maximise``, or first designs are no tensor.

    Example:
        >>> from coim import HopperMorph, ParticleSwarm
        >>> spec = HopperMorph(seed=0).design_spec
        >>> choice = DesignChoice(spec, torch.ones(1, 4), search=ParticleSwarm(spec, seed=0), seed=0)
        >>> choice.first_designs.shape
        torch.Size([1, 4])
    """

    def __init__(
        self,
        spec: Bounded,
        first_designs: Tensor,
        *,
        search: DesignSearch | None = None,
        bodies: Literal["search", "random", "fixed"] = "search",
        num_start_states: int = 36,
        value_states: StatesAre = "stored",
        value_over: Literal["start", "visited"] = "start",
        reach: float | None = None,
        widening: float = 0.0,
        precision: Literal["float32", "bfloat16"] = "float32",
        seed: int = 0,
    ) -> None:
        check_words(
            bodies=(bodies, ("search", "random", "fixed")),
            value_states=(value_states, ("stored", "matched")),
            value_over=(value_over, ("start", "visited")),
            precision=(precision, ("float32", "bfloat16")),
        )
        check_counts({"num_start_states": num_start_states}, {})
        _check_first_designs(spec, first_designs)
        if bodies == "search" or search is not None:
            _check_search(spec, search)
        if reach is not None:
            check_reach(reach)
        check_widening(widening, reach)
        self.spec, self.first_designs, self.search, self.bodies = spec, first_designs.clone(), search, bodies
        self.num_start_states, self.value_states, self.value_over = num_start_states, value_states, value_over
        self.precision, self.reach, self.widening = precision, reach, widening
        # On the CPU wherever the networks are: there the same seed gives the same bodies.
        self.rng = stream("designs", seed)

    def choose(self, situation: Situation) -> DesignChosen:
        """Choose the next body of every run; one that has diverged keeps the body that it has."""
        # One draw of states for the choice and for what is predicted. Before the first episode there is none.
        values = self.fitness(situation) if len(situation.buffers.s0) > 0 else []
        objectives = self.objectives(situation, values)
        kind, predicted = self._kind(situation.index), None
        if kind == "optimised":
            found = [self.maximise(situation, run, objective) for run, objective in enumerate(objectives)]
            design = torch.stack([self._checked(design) for design, _ in found])
            if objectives is values:
                predicted = torch.tensor([value for _, value in found], dtype=torch.float32, device="cpu")
        elif kind == "random":
            design = self.explore(situation)
        else:
            index = 0 if kind == "fixed" else situation.index
            design = self.first_designs[index].expand(situation.num_runs, -1).clone()
        if predicted is None and values:
            each = [value(row.unsqueeze(0))[0] for value, row in zip(values, design)]
            predicted = torch.stack(each).cpu()
        expected = self.expect(objectives, design)
        if frozen := [*situation.diverged]:
            design = design.clone()
            design[frozen] = situation.present[frozen].to(design.device)
            predicted = None if predicted is None else _without(predicted, frozen)
            expected = None if expected is None else (_without(expected[0], frozen), _without(expected[1], frozen))
        mean, deviation = expected or (None, None)
        return DesignChosen(
            situation.index, kind, design, predicted, dict(situation.diverged), expected=mean, deviation=deviation
        )

    def fitness(self, situation: Situation) -> list[Fitness]:
        """Eq. 5 of each run, ``K`` of them, over the same draw of states.

        A run that has diverged has nothing to climb.
        """
        buffers, policy, qvalue = situation.buffers, situation.population.policy, situation.population.qvalue
        source = buffers.s0 if self.value_over == "start" else buffers.pop
        states = source.sample(self.num_start_states).to(self.first_designs.device)
        value = functools.partial(
            DesignValue, precision=self.precision, start_states_are=self.value_states, env=situation.env
        )
        if policy.num_runs is None:
            return [value(policy, qvalue, states[:, 0])]
        return [
            value(select_run(policy, k), select_run(qvalue, k), states[:, k])
            if k not in situation.diverged
            else _flat_fitness
            for k in range(situation.num_runs)
        ]

    def objectives(self, situation: Situation, values: list[Fitness]) -> list[Fitness]:
        """What the search maximises for each run: Eq. 5, ``values``, as `fitness` has given it."""
        return values

    def maximise(self, situation: Situation, run: int, objective: Fitness) -> tuple[Tensor, float]:
        """Search the next body of one run: the design ``[D]`` and what the objective says of it."""
        assert self.search is not None
        if self.reach is None or run in situation.diverged:
            return self.search.maximise(objective)
        returns = torch.stack([done.best_return[run] for done in situation.tried]).nan_to_num(nan=-torch.inf)
        best = situation.tried[int(returns.argmax())].design[run]
        reach = min(1.0, self.reach + self.widening * max(0, situation.index - len(self.first_designs)))
        return TrustRegion(self.spec, self.search, reach=reach).maximise(objective, centre=best)

    def _checked(self, found: Tensor) -> Tensor:
        """What a search has found, as the bodies take it; refuse what they cannot have."""
        low, high = self.spec.space.low, self.spec.space.high
        if not isinstance(found, Tensor) or found.shape != low.shape:
            shape = list(found.shape) if isinstance(found, Tensor) else type(found).__name__
            raise ValueError(f"the search has found {shape}; it must return one design [{len(low)}] and its value")
        design = found.detach().to(low)
        if not bool(((low <= design) & (design <= high)).all()):
            raise ValueError(
                f"the search has found {found.tolist()}, which leaves [{low.tolist()}, {high.tolist()}]; let it end "
                "with spec.project()"
            )
        return design

    def expect(self, objectives: list[Fitness], design: Tensor) -> tuple[Tensor, Tensor] | None:
        """Mean and deviation of the best return that is expected of designs ``[K, D]``, each ``[K]`` on the CPU.

        Eq. 5 is no return: None.
        """
        return None

    def explore(self, situation: Situation) -> Tensor:
        """Uniform designs, ``[K, D]``: the exploration step of Algorithm 1."""
        like = self.first_designs[0].cpu().expand(situation.num_runs, -1)
        return RandomDesigns(self.spec)(like, rng=self.rng).to(self.first_designs.device)

    def check_fits(self, env: MorphEnv) -> None:
        """Refuse to choose among designs that the bodies cannot have.

        Raises:
            ValueError: if this one's bounds leave those of the bodies or are on another device, there are first designs
                for another number of runs, or states are to be matched and the bodies cannot tell how high they stand.
        """
        runs = env.batch_size.numel()
        if self.first_designs.ndim == 3 and self.first_designs.shape[1] != runs:
            raise ValueError(
                f"first_designs has shape {list(self.first_designs.shape)}, bodies for {self.first_designs.shape[1]} "
                f"runs, and env has {runs}; pass [I, D] for all runs, or [I, {runs}, D]"
            )
        _check_within("design_choice chooses", self.spec, env.design_spec)
        if self.value_states == "matched":
            check_transfer(env)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the random numbers and of the search, if it has one."""
        save = getattr(self.search, "state_dict", None)
        return {"search": None if save is None else save(), "rng": self.rng.get_state()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on as the one that :meth:`state_dict` was read from."""
        restore_generator(self.rng, state_dict["rng"])
        load = getattr(self.search, "load_state_dict", None)
        if load is not None and state_dict["search"] is not None:
            load(state_dict["search"])

    def _kind(self, index: int) -> Kind:
        if self.bodies == "fixed":
            return "fixed"
        since = index - len(self.first_designs)
        if since < 0:
            return "first"
        return "optimised" if self.bodies == "search" and since % 2 == 0 else "random"


def _without(numbers: Tensor, frozen: list[int]) -> Tensor:
    """A copy of ``[K]`` in which these runs have NaN."""
    numbers = numbers.clone()
    numbers[frozen] = torch.nan
    return numbers


def _flat_fitness(designs: Tensor) -> Tensor:
    """Stand in for Eq. 5 of a run that keeps its body; its search draws as many numbers as any, ``[P, D] -> [P]``."""
    return 0.0 * designs.sum(-1)


def _check_first_designs(spec: Bounded, first_designs: Tensor) -> None:
    """Refuse first designs that the bodies or the networks could not take; the last of them is built hours later."""
    if not isinstance(first_designs, Tensor):
        raise TypeError(f"first_designs is a {type(first_designs).__name__}; pass a Tensor")
    low, high = spec.space.low, spec.space.high
    if first_designs.ndim not in (2, 3) or first_designs.shape[-1:] != spec.shape or not first_designs.numel():
        raise ValueError(
            f"first_designs has shape {list(first_designs.shape)}, expected [I, {spec.shape[0]}], or "
            f"[I, K, {spec.shape[0]}] for K runs, with at least one row"
        )
    if first_designs.device != low.device or first_designs.dtype != spec.dtype:
        raise ValueError(
            f"first_designs are {first_designs.dtype} on {first_designs.device}, the bodies take {spec.dtype} on "
            f"{low.device}; move them by first_designs.to({str(low.device)!r}, {spec.dtype})"
        )
    within = (low <= first_designs) & (first_designs <= high)
    if not within.all():
        *_, entry = (~within).nonzero()[0].tolist()
        raise ValueError(
            f"a first design has {first_designs[~within][0].item():g} as its entry {entry + 1} of {len(low)}, which "
            f"must lie in [{low[entry]:g}, {high[entry]:g}]"
        )


def _check_search(spec: Bounded, search: DesignSearch | None) -> None:
    """Refuse a search that leaves the bounds; one without ``spec`` is believed."""
    if isinstance(search, type) or not callable(getattr(search, "maximise", None)):
        what = f"the class {search.__name__}" if isinstance(search, type) else f"a {type(search).__name__}"
        raise TypeError(f"search is {what}; pass a DesignSearch, such as ParticleSwarm(env.design_spec, seed=0)")
    if (own := getattr(search, "spec", None)) is not None:
        _check_within("the search looks", own, spec)


def _check_within(what: str, inner: Bounded, outer: Bounded) -> None:
    """Refuse bounds that leave others, or that are elsewhere."""
    own, bodies = inner.space, outer.space
    alike = inner.shape == outer.shape and own.low.device == bodies.low.device
    if not alike or (own.low < bodies.low).any() or (own.high > bodies.high).any():
        raise ValueError(
            f"{what} among designs of [{own.low.tolist()}, {own.high.tolist()}] on {own.low.device}, the bodies have "
            f"those of [{bodies.low.tolist()}, {bodies.high.tolist()}] on {bodies.low.device}; make it with "
            "env.design_spec"
        )
