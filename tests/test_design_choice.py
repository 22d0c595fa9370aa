"""Which body comes next: what a choice is handed, and another way of choosing."""

from __future__ import annotations

import io
from collections.abc import Mapping
from itertools import islice
from typing import Any

import pytest
import torch
from small_algorithm import STEPS, small
from torch import Tensor

from coim import (
    CoAdaptation,
    DesignChoice,
    DesignChosen,
    DesignDone,
    Event,
    HopperMorph,
    ParticleSwarm,
    RandomDesigns,
    Situation,
)
from coim.designs.search import Fitness
from coim.randomness import restore_generator, stream

SPEC = HopperMorph(seed=0).design_spec


class BesideTheBest(DesignChoice):
    """Climb to the best design so far, explore near it, and remember how often."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(SPEC, torch.ones(1, 4), search=ParticleSwarm(SPEC, num_particles=9, seed=0), **settings)
        self.handed: list[Situation] = []
        self.noise = torch.Generator().manual_seed(7)

    def fitness(self, situation: Situation) -> list[Fitness]:
        best = self._best(situation)
        return [lambda designs, run=run: -(designs - best[run]).square().sum(-1) for run in range(situation.num_runs)]

    def explore(self, situation: Situation) -> Tensor:
        best = self._best(situation)
        return (best + 0.1 * torch.rand(best.shape, generator=self.noise)).clamp(max=2.0)

    def choose(self, situation: Situation) -> DesignChosen:
        self.handed.append(Situation(**{**vars(situation), "tried": list(situation.tried)}))
        return super().choose(situation)

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "noise": self.noise.get_state()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        super().load_state_dict(state_dict)
        restore_generator(self.noise, state_dict["noise"])

    @staticmethod
    def _best(situation: Situation) -> Tensor:
        returns = torch.stack([done.best_return for done in situation.tried] or [torch.zeros(situation.num_runs)])
        designs = torch.stack([done.design for done in situation.tried] or [torch.ones(situation.num_runs, 4)])
        return designs[returns.argmax(0), torch.arange(situation.num_runs)]


def choosing(**settings: Any) -> CoAdaptation:
    """An algorithm whose bodies are chosen in this way."""
    return small(2, imagine=False, design_choice=BesideTheBest(), **settings)


def saved(algorithm: CoAdaptation) -> Any:
    """The state as it comes back from a file."""
    file = io.BytesIO()
    torch.save(algorithm.state_dict(), file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def test_a_choice_is_handed_every_design_so_far_with_its_kind_and_best_return() -> None:
    algorithm = choosing()
    events = list(algorithm)
    done = [event for event in events if isinstance(event, DesignDone)]
    last = algorithm.design_choice.handed[-1]  # type: ignore[attr-defined]
    assert [event.index for event in last.tried] == [0, 1, 2, 3]
    assert [event.kind for event in last.tried] == ["first", "optimised", "random", "optimised"]
    for event, expected in zip(last.tried, done):
        assert torch.equal(event.design, expected.design)
        assert torch.equal(event.best_return, expected.best_return)


def test_another_way_of_choosing_is_a_subclass() -> None:
    chosen = [event for event in choosing() if isinstance(event, DesignChosen)]
    assert [event.kind for event in chosen] == ["first", "optimised", "random", "optimised", "random"]
    torch.testing.assert_close(chosen[1].design, torch.ones(2, 4), atol=0.1, rtol=0)  # the swarm finds the best so far
    assert not torch.equal(chosen[2].design[0], chosen[2].design[1])
    assert chosen[2].predicted is not None
    assert (chosen[2].predicted <= 0).all()  # by its own fitness


def test_it_resumes_to_the_last_bit_with_the_designs_so_far() -> None:
    expected, stop = list(choosing()), 9
    first, second = choosing(), choosing()
    list(islice(first, stop))
    second.load_state_dict(saved(first))

    def bodies(events: list[Event]) -> list[list[float]]:
        return [event.design.tolist() for event in events if isinstance(event, DesignChosen)]

    assert bodies(list(second)) == bodies(expected[stop:])


def test_the_states_of_all_designs_and_the_present_bodies_are_there() -> None:
    algorithm = choosing(num_designs=3)
    list(algorithm)
    choice = algorithm.design_choice
    assert isinstance(choice, BesideTheBest)
    last = choice.handed[-1]
    assert len(last.buffers.pop) == 4 * STEPS
    assert torch.equal(last.present, algorithm.position.tried[-1].design)


def test_each_run_may_have_first_bodies_of_its_own() -> None:
    bodies = torch.tensor([[[0.6, 1.0, 1.0, 1.0], [1.0, 1.4, 1.0, 2.0]]])  # [I, K, D]
    algorithm = small(2, imagine=False, first_designs=bodies, num_designs=2)
    chosen = [event.design for event in algorithm if isinstance(event, DesignChosen)]
    assert torch.equal(chosen[0], bodies[0])
    assert torch.equal(algorithm.buffers.pop[0]["design"], bodies[0])
    assert not torch.equal(chosen[1], bodies[0])
    with pytest.raises(ValueError, match=r"shape \[1, 2, 4\], bodies for 2 runs, and env has 3; pass .* \[I, 3, D\]"):
        small(3, imagine=False, first_designs=bodies)


def test_random_designs_have_numbers_of_their_own() -> None:
    algorithm = small(2, bodies="random", seed=3)
    found = [event.design for event in algorithm if isinstance(event, DesignChosen) and event.kind == "random"]
    draw, rng = RandomDesigns(SPEC), stream("designs", 3)
    for design in found:
        assert torch.equal(design, draw(torch.ones(2, 4), rng=rng))


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"num_start_states": 0}, "num_start_states is 0, it must be at least 1"),
        ({"value_states": "moved"}, "value_states='moved' is unknown; choose 'stored' or 'matched'"),
        ({"precision": "float16"}, "precision='float16' is unknown"),
    ],
)
def test_a_choice_checks_its_own_settings(settings: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        DesignChoice(SPEC, torch.ones(1, 4), search=ParticleSwarm(SPEC, seed=0), **settings)


class Finding:
    """A search that always finds the same."""

    def __init__(self, found: Any) -> None:
        self.found = found

    def maximise(self, fitness: Fitness) -> tuple[Any, float]:
        return self.found, 0.0


@pytest.mark.parametrize(
    ("found", "sentence"),
    [
        (torch.ones(1, 4), r"the search has found \[1, 4\]; it must return one design \[4\]"),
        ([1.0] * 4, "the search has found list"),
        (torch.full((4,), 2.1), r"the search has found \[2.09.*, which leaves .*project"),
        (torch.full((4,), torch.nan), r"the search has found \[nan"),
    ],
)
def test_what_a_search_finds_is_checked(found: Any, sentence: str) -> None:
    choice = DesignChoice(SPEC, torch.ones(1, 4), search=Finding(found), num_start_states=2)
    with pytest.raises(ValueError, match=sentence):
        list(small(imagine=False, design_choice=choice, num_designs=2))


def test_what_a_search_of_numpy_finds_is_a_design_of_the_bodies() -> None:
    found = torch.full((4,), 1.3, dtype=torch.float64, requires_grad=True)
    choice = DesignChoice(SPEC, torch.ones(1, 4), search=Finding(found), num_start_states=2)
    *_, done = small(imagine=False, design_choice=choice, num_designs=2)
    assert torch.equal(done.design, torch.full((1, 4), 1.3))
    assert not done.design.requires_grad


def test_who_listens_may_write_over_what_is_told() -> None:
    first = torch.tensor(HopperMorph.FIRST_DESIGNS[:2])
    told, written_over = [], []
    for listener in (told, written_over):
        given = first.clone()
        algorithm = small(first_designs=given, num_designs=5)
        given.fill_(7.0)
        for event in algorithm:
            listener.append(event.design.clone())
            if listener is written_over:
                event.design.fill_(1.5)
                if isinstance(event, DesignDone):
                    event.best_return.neg_()
        assert torch.equal(algorithm.design_choice.first_designs, first)
    assert all(map(torch.equal, told, written_over))
    assert len(told) == len(written_over)
