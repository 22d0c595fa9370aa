"""The next body by a Gaussian process over the returns of those that were tried."""

from __future__ import annotations

import io
from itertools import islice
from typing import Any

import pytest
import torch
from small_algorithm import small
from torch import Tensor

from coim import CoAdaptation, DesignChosen, DesignDone, Event, GradientSearch, HopperMorph, ParticleSwarm
from coim.design_choice import Situation
from coim.designs import DesignPosterior
from coim.designs.search import Fitness
from coim.posterior_choice import PosteriorChoice

SPEC = HopperMorph(seed=0).design_spec
FIRST = torch.tensor(HopperMorph.FIRST_DESIGNS[:3])


def choosing(
    num_runs: int = 1, *, designs: int = 7, kind: type[PosteriorChoice] = PosteriorChoice, **settings: Any
) -> CoAdaptation:
    search = GradientSearch(SPEC, num_starts=16, num_steps=20, seed=0)
    choice = kind(SPEC, FIRST, search=search, num_start_states=4, seed=0, **settings)
    return small(num_runs, imagine=False, design_choice=choice, num_designs=designs, first_episodes=1)


def chosen_of(events: list[Event]) -> list[DesignChosen]:
    return [event for event in events if isinstance(event, DesignChosen)]


class Watched(PosteriorChoice):
    """Keeps, for each body from the fourth on, what a posterior that is made by hand says of it and of 200 others."""

    def __init__(self, *given: Any, **settings: Any) -> None:
        super().__init__(*given, **settings)
        self.seen: dict[int, list[dict[str, Tensor]]] = {}

    def objectives(self, situation: Situation, values: list[Fitness]) -> list[Fitness]:
        self.situation, self.values = situation, values
        return super().objectives(situation, values)

    def expect(self, objectives: list[Fitness], design: Tensor) -> tuple[Tensor, Tensor] | None:
        tried, others = self.situation.tried, torch.rand(200, 4) * 1.5 + 0.5
        if len(tried) > 2:
            self.seen[self.situation.index] = [
                {"predicted": torch.cat(own.predict(body)), "chosen": own(body), "others": own(others)}
                for run, body in enumerate(design.unsqueeze(1))
                for own in [
                    DesignPosterior(
                        SPEC,
                        torch.stack([done.design[run] for done in tried]),
                        torch.stack([done.best_return[run] for done in tried]),
                        prior=self.values[run] if self.critic else None,
                    )
                ]
            ]
        return super().expect(objectives, design)


@pytest.mark.parametrize("critic", [True, False])
@pytest.mark.parametrize("num_runs", [1, 2])
def test_each_run_maximises_the_posterior_of_its_own_bodies(num_runs: int, critic: bool) -> None:
    algorithm = choosing(num_runs, kind=Watched, critic=critic)
    events = chosen_of(list(algorithm))[3:]  # from the fourth body on there are three returns
    seen = algorithm.design_choice.seen
    assert len(events) == len(seen) == 4
    for event in events:
        assert event.expected is not None
        assert event.deviation is not None
        assert event.predicted is not None  # Eq. 5, as for all other choices
        by_hand = seen[event.index]
        torch.testing.assert_close(
            torch.stack([event.expected, event.deviation], -1), torch.stack([x["predicted"] for x in by_hand])
        )
        if event.kind == "optimised":
            for own in by_hand:
                others = own["others"]
                assert own["chosen"] > others.max() - 0.02 * (others.max() - others.min())


def test_before_three_returns_are_known_eq_5_is_maximised_as_without_it() -> None:
    first = FIRST[:1]
    searches = [ParticleSwarm(SPEC, num_particles=9, num_iterations=3, seed=0) for _ in range(2)]
    choice = PosteriorChoice(SPEC, first, search=searches[0], num_start_states=4, seed=0)
    with_it = chosen_of(list(small(1, imagine=False, design_choice=choice, num_designs=3)))
    without = chosen_of(
        list(small(1, imagine=False, search=searches[1], first_designs=first, num_start_states=4, num_designs=3))
    )
    for one, other in zip(with_it, without):
        assert (one.kind, one.expected) == (other.kind, None)
        assert torch.equal(one.design, other.design)


def test_it_resumes_to_the_last_bit() -> None:
    expected, stop = list(choosing(2)), 11
    first, second = choosing(2), choosing(2)
    list(islice(first, stop))
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    second.load_state_dict(torch.load(file, weights_only=True))
    gone_on = chosen_of(list(second))
    assert gone_on
    for one, other in zip(gone_on, chosen_of(expected[stop:])):
        assert torch.equal(one.design, other.design)
        assert one.expected is not None
        assert other.expected is not None
        assert torch.equal(one.expected, other.expected)


def test_a_run_that_has_diverged_expects_nothing() -> None:
    algorithm = choosing(2, designs=6)
    for event in algorithm:
        if isinstance(event, DesignDone) and event.index == 3:
            algorithm.divergence.places[1] = (3, 0)
        if isinstance(event, DesignChosen) and event.index == 4:
            assert event.expected is not None
            assert event.deviation is not None
            assert event.expected.isnan().tolist() == event.deviation.isnan().tolist() == [False, True]


def test_a_reach_may_widen_with_each_body_until_it_is_everywhere() -> None:
    events = list(choosing(1, designs=9, reach=0.1, widening=0.3))
    done = {event.index: event for event in events if isinstance(event, DesignDone)}
    first, distances = len(FIRST), {}
    for event in chosen_of(events):
        if event.kind == "optimised":
            best = max((done[index] for index in range(event.index)), key=lambda before: before.best_return[0].item())
            distances[event.index] = (event.design - best.design).abs().max().item()
    limits = {index: min(1.0, 0.1 + 0.3 * (index - first)) * 1.5 + 1e-6 for index in distances}
    assert len(distances) > 1
    assert all(distances[index] <= limits[index] for index in distances)
    assert max(distances.values()) > 0.1 * 1.5 + 1e-3  # it did widen
    for widening, reach, words in (
        (-0.1, 0.2, "widening is -0.1, it must be 0 or more"),
        (0.1, None, "without a reach"),
    ):
        with pytest.raises(ValueError, match=words):
            PosteriorChoice(SPEC, FIRST, search=GradientSearch(SPEC, seed=0), reach=reach, widening=widening)


def test_a_reach_keeps_the_search_around_the_best_body() -> None:
    algorithm = choosing(1, reach=0.1)
    events = list(algorithm)
    done = {event.index: event for event in events if isinstance(event, DesignDone)}
    searched = [event for event in chosen_of(events) if event.kind == "optimised"]
    assert searched
    for event in searched:
        best = max((done[index] for index in range(event.index)), key=lambda before: before.best_return[0].item())
        assert (event.design - best.design).abs().max() <= 0.1 * 1.5 + 1e-6
    with pytest.raises(ValueError, match=r"reach is 0, it must be in \(0, 1\]"):
        PosteriorChoice(SPEC, FIRST, search=GradientSearch(SPEC, seed=0), reach=0)
