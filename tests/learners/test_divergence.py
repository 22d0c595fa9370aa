"""A run that diverges is found, frozen and told; the others are, to the last bit, what they would have been."""

from __future__ import annotations

import io
from collections.abc import Callable
from itertools import islice
from typing import Any

import pytest
import torch
from small_algorithm import STEPS, small
from tensordict import TensorDict
from torch import Tensor

from coim import CoAdaptation, DesignChosen, DesignDone, EpisodeDone, Event, GradientSearch
from coim.events import running
from coim.learners.divergence import LARGEST_WEIGHT, Divergence

Poison = Callable[[Any, TensorDict], None]


def weights(number: float) -> Poison:
    def spoil(learner: Any, losses: TensorDict) -> None:
        learner.weights_by_run()[0][1, 0] = number

    return spoil


def moments(learner: Any, losses: TensorDict) -> None:
    learner.moments_by_run()[-1][1] = torch.inf


def losses_alone(learner: Any, losses: TensorDict) -> None:
    next(iter(losses.values()))[1] = torch.nan


def poisoned(algorithm: CoAdaptation, who: str, spoil: Poison, *, call: int = 3) -> CoAdaptation:
    """Let run 1 of a learner diverge in its updates of one episode, counted from 1, and of all later ones."""
    learner, calls = getattr(algorithm, who), 0
    update = learner.update

    def update_and_spoil(batches: Any) -> TensorDict:
        nonlocal calls
        calls += 1
        losses = update(batches)
        if calls >= call:
            spoil(learner, losses)
        return losses

    learner.update = update_and_spoil
    return algorithm


def numbers(event: Event) -> dict[str, Tensor]:
    """All that an event says of the runs, ``[K, ...]`` each."""
    found = {name: value for name, value in vars(event).items() if isinstance(value, Tensor)}
    return found | (event.metrics if isinstance(event, EpisodeDone) else {})


def same(one: Event, other: Event, runs: list[int]) -> None:
    """Assert that two events tell the same of some runs, to the last bit."""
    assert type(one) is type(other)
    assert numbers(one).keys() == numbers(other).keys()
    for name, value in numbers(one).items():
        assert torch.equal(value[runs], numbers(other)[name][runs]), name


CASES = {
    "individual, weights": ("individual", weights(torch.nan)),
    "population, weights": ("population", weights(-torch.inf)),
    "ensemble, weights": ("dynamics", weights(torch.inf)),
    "weights whose products overflow": ("individual", weights(2 * LARGEST_WEIGHT)),
    "population, moments": ("population", moments),
    "individual, losses": ("individual", losses_alone),
    "ensemble, losses": ("dynamics", losses_alone),
}


@pytest.mark.parametrize(("who", "spoil"), CASES.values(), ids=CASES)
def test_the_other_runs_are_what_they_would_have_been(who: str, spoil: Poison) -> None:
    healthy, ill = small(3, sigma=0.1), poisoned(small(3, sigma=0.1), who, spoil)
    expected = list(healthy)
    events = list(ill)
    assert len(events) == len(expected)
    for event, other in zip(events, expected):
        same(event, other, [0, 2])
    for learner, other in zip(ill.divergence.learners, healthy.divergence.learners):
        for tensor, wanted in zip(learner.weights_by_run(), other.weights_by_run()):
            assert torch.equal(tensor[[0, 2]], wanted[[0, 2]])
            assert tensor.isfinite().all()
        assert all(moment.isfinite().all() for moment in learner.moments_by_run())
    rows = ill.buffers.pop[:]
    assert torch.equal(rows["observation"][:, [0, 2]], healthy.buffers.pop[:]["observation"][:, [0, 2]])
    assert all(value.isfinite().all() for value in rows.exclude("index").values(True, True))
    # The third episode is the first of the second design.
    assert [event.diverged for event in events] == [{}] * 5 + [{1: (1, 0)}] * (len(events) - 5)


def test_a_run_that_has_diverged_has_no_numbers_any_more_and_keeps_its_body() -> None:
    events = list(poisoned(small(3), "individual", weights(torch.nan)))
    at = next(i for i, event in enumerate(events) if event.diverged)
    assert isinstance(events[at], EpisodeDone)
    assert all(running(event) == [0, 1, 2] for event in events[: at + 1])
    assert numbers(events[at])["training_return"].isfinite().all()
    assert numbers(events[at])["evaluation_return"].isfinite().all()
    for event in events[at + 1 :]:
        assert torch.equal(event.design[1], events[at].design[1])
        whole = isinstance(event, DesignDone) and event.index == 1
        assert running(event) == ([0, 1, 2] if whole else [0, 2])
        for name, value in numbers(event).items():
            if name != "design":
                assert value[[0, 2]].isfinite().all()
                assert value[1].isfinite() == whole, name
    done = next(event for event in events if isinstance(event, DesignDone) and event.index == 1)
    assert done.best_return[1] == numbers(events[at])["evaluation_return"][1]


def test_it_acts_with_the_weights_of_before_the_updates_that_it_did_not_survive() -> None:
    algorithm = poisoned(small(3), "individual", weights(torch.nan), call=2)
    events = iter(algorithm)
    before: list[Tensor] = []
    for event in events:
        if isinstance(event, EpisodeDone):
            now = [tensor[1].clone() for tensor in algorithm.individual.weights_by_run()]
            assert not event.diverged or all(torch.equal(*pair) for pair in zip(now, before, strict=True))
            if event.diverged:
                break
            before = now
    assert event.diverged == {1: (0, 1)}


def test_the_search_draws_as_many_numbers_for_it() -> None:
    def searching() -> CoAdaptation:
        algorithm = small(3)
        algorithm.design_choice.search = GradientSearch(algorithm.env.design_spec, num_starts=3, num_steps=2, seed=0)
        return algorithm

    expected = list(searching())
    for event, other in zip(poisoned(searching(), "population", weights(torch.nan)), expected, strict=True):
        same(event, other, [0, 2])


def test_it_is_frozen_in_the_run_that_goes_on_too() -> None:
    def ill() -> CoAdaptation:
        return poisoned(small(3), "population", weights(torch.nan))

    expected = list(ill())
    for stop in range(5, len(expected), 3):  # an episode is over, a body is chosen, a body is done
        first, second = ill(), small(3)
        list(islice(first, stop))
        file = io.BytesIO()
        torch.save(first.state_dict(), file)
        file.seek(0)
        second.load_state_dict(torch.load(file, weights_only=True))
        poisoned(second, "population", weights(torch.nan), call=0)
        events = list(second)
        assert len(events) == len(expected) - stop
        for event, other in zip(events, expected[stop:]):
            assert event.diverged == other.diverged
            for name, value in numbers(event).items():
                assert torch.equal(value.nan_to_num(nan=1e9), numbers(other)[name].nan_to_num(nan=1e9)), name


@pytest.mark.parametrize("num_runs", [1, 2])
def test_when_no_run_is_left_the_design_is_over_and_there_is_no_other(num_runs: int) -> None:
    def all_ill(learner: Any, losses: TensorDict) -> None:
        losses["loss_qvalue"][:] = torch.inf

    algorithm = poisoned(small(num_runs), "population", all_ill, call=3)
    events = list(algorithm)
    assert [type(event) for event in events[-3:]] == [DesignChosen, EpisodeDone, DesignDone]
    assert events[-1].diverged == {run: (1, 0) for run in range(num_runs)}
    assert list(algorithm) == []
    assert len(algorithm.buffers.pop) == 3 * STEPS
    again = small(num_runs)
    again.load_state_dict(algorithm.state_dict())
    assert list(again) == []


def test_a_run_that_diverges_by_itself_is_found() -> None:
    algorithm = small(1)
    algorithm.individual.optimiser.param_groups[0]["lr"] = 1e30
    events = list(algorithm)
    assert [type(event) for event in events] == [DesignChosen, EpisodeDone, DesignDone]
    assert events[-1].diverged == {0: (0, 0)}


def test_what_diverged_is_found_whatever_torchs_default_device_is() -> None:
    class Learner:
        def weights_by_run(self) -> list[Tensor]:
            return [kept]

        def moments_by_run(self) -> list[Tensor]:
            return []

    kept = torch.ones(2, 3)
    with torch.device("meta"):
        divergence = Divergence(2, [Learner()])
        divergence.remember()
        kept[1] = torch.inf
        divergence.contain({"loss": torch.zeros(2, device="cpu")}, (0, 0))
    assert divergence.places == {1: (0, 0)}
    assert kept.tolist() == [[1.0] * 3] * 2
