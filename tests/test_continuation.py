"""An algorithm that loads the state of an interrupted one goes on as if nothing had happened, to the last bit."""

from __future__ import annotations

import io
from dataclasses import replace
from itertools import islice
from typing import Any

import pytest
import torch
from small_algorithm import small

from coim import CoAdaptation, DesignChosen, DesignDone, EpisodeDone, Event


def equal(one: Any, other: Any, path: str = "state") -> None:
    """Assert that two nested states are the same to the last bit."""
    assert type(one) is type(other), path
    if isinstance(one, dict):
        assert one.keys() == other.keys(), path
        for key in one:
            equal(one[key], other[key], f"{path}.{key}")
    elif isinstance(one, list):
        assert len(one) == len(other), path
        for index, (own, its) in enumerate(zip(one, other)):
            equal(own, its, f"{path}[{index}]")
    elif isinstance(one, torch.Tensor):
        assert torch.equal(one, other), path
    else:
        assert one == other, path


def told(event: Event) -> dict[str, Any]:
    """What an event says, without the clock."""
    return {name: value for name, value in vars(event).items() if name != "seconds"}


def saved(algorithm: CoAdaptation) -> Any:
    """The state as it comes back from a file."""
    file = io.BytesIO()
    torch.save(algorithm.state_dict(), file)
    file.seek(0)
    return torch.load(file, weights_only=True)


KINDS = {
    "paper": {},
    "baseline": {"imagine": False},
    "fleet": {"num_runs": 3},
    "native episodes": {"num_runs": 3, "native_episodes": True},
    "side by side, mixed": {
        "side_by_side": True,
        "individual_mix": 0.2,
        "individual_imagined_share": 0.3,
        "sigma": 0.1,
    },
}


@pytest.mark.parametrize("settings", KINDS.values(), ids=KINDS)
def test_an_interrupted_run_goes_on_as_the_uninterrupted_one(settings: dict[str, Any]) -> None:
    whole = small(**settings)
    expected = list(whole)
    stops = [i for i, event in enumerate(expected) if not isinstance(event, DesignDone)]
    # Before anything, in the middle of a first design, and before and after an optimised and a random one.
    for stop in (0, 2, *stops[-5:]):
        first, second = small(**settings), small(**settings)
        list(islice(first, stop))
        state = saved(first)
        for event in first:  # what the first does afterwards is nothing to the second
            if isinstance(event, EpisodeDone):
                break
        torch.manual_seed(12345)
        second.load_state_dict(state)
        events = list(second)
        assert len(events) == len(expected) - stop
        for event, other in zip(events, expected[stop:]):
            equal(told(event), told(other), f"{stop}")
        equal(second.state_dict(), whole.state_dict())


def test_loading_shares_nothing_with_the_state() -> None:
    first, second = small(), small()
    list(islice(first, 3))
    state = first.state_dict()
    second.load_state_dict(state)
    kept = saved(first)
    list(second)
    equal(first.state_dict(), kept)


def test_a_state_can_be_loaded_into_one_that_has_run() -> None:
    first, second = small(), small()
    list(islice(first, 4))
    list(islice(second, 9))
    second.load_state_dict(saved(first))
    for event, other in zip(second, first, strict=True):
        equal(told(event), told(other))


def test_iterating_again_goes_on_in_the_middle_of_a_design() -> None:
    expected, algorithm = list(small()), small()
    events = [event for _ in range(20) for event in islice(algorithm, 1)]
    assert [type(event) for event in events] == [type(event) for event in expected]
    for event, other in zip(events, expected):
        equal(told(event), told(other))


def test_more_designs_may_follow() -> None:
    expected, first, second = list(small(num_designs=5)), small(num_designs=3), small(num_designs=5)
    done = list(first)
    second.load_state_dict(saved(first))
    events = [*done, *second]
    assert isinstance(events[len(done)], DesignChosen)
    for event, other in zip(events, expected, strict=True):
        equal(told(event), told(other))


@pytest.mark.parametrize("settings", [{}, {"imagine": False}], ids=["paper", "baseline"])
def test_a_state_of_before_the_choice_of_bodies_had_its_own_goes_on(settings: dict[str, Any]) -> None:
    whole = small(**settings)
    expected = list(whole)
    for stop in (0, 9, len(expected) - 2):
        first, second = small(**settings), small(**settings)
        list(islice(first, stop))
        state = saved(first)
        choice = state.pop("design_choice")
        state["search"], state["rngs"]["designs"] = choice["search"], choice["rng"]
        del state["position"]["tried"]
        second.load_state_dict(state)
        for event, other in zip(second, expected[stop:], strict=True):
            equal(told(event), told(other))


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"imagine": False}, "has a dynamics and the other has none"),
        (
            {"num_runs": 2},
            r"policy.layers.0.weight is \(15, 8\) in the state and \(2, 15, 8\) in this learner; make it with",
        ),
    ],
)
def test_another_algorithm_is_refused(settings: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        small(**settings).load_state_dict(small().state_dict())


def test_an_interrupt_does_not_wait_for_the_other_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    algorithm = small(imagine=False, side_by_side=True)
    algorithm.training.plan = replace(algorithm.training.plan, population_updates=10**9)  # years

    def interrupted(batches: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(algorithm.individual, "update", interrupted)
    with pytest.raises(KeyboardInterrupt):
        list(algorithm)
    algorithm.training._beside.shutdown(wait=True)  # type: ignore[union-attr]
