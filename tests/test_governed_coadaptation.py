"""Algorithm 1 whose imagination is matched, anchored and governed, and its measurements.  K runs."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from small_algorithm import small
from tensordict import TensorDictBase
from torch import Tensor

from coim import (
    CoAdaptation,
    DesignChosen,
    DesignValue,
    DynamicsLearner,
    EpisodeDone,
    Event,
    HopperMorph,
    WorldModelEnv,
    design_choice,
)


def weights(algorithm: CoAdaptation) -> list[Tensor]:
    """All that population and individual have learnt, ``[K, ...]`` each."""
    found = [*algorithm.population.weights_by_run(), *algorithm.individual.weights_by_run()]
    return [tensor.detach().clone() for tensor in found]


def told(events: list[Event]) -> list[Any]:
    """What the events say of bodies and returns."""
    found = []
    for event in events:
        if isinstance(event, EpisodeDone):
            losses = {k: v for k, v in event.metrics.items() if k.startswith(("population", "individual"))}
            found.append((event.index, event.episode, event.training_return, event.evaluation_return, losses))
        elif isinstance(event, DesignChosen):
            found.append((event.index, event.kind, event.design, event.predicted))
    return found


def same(one: Any, other: Any, run: slice = slice(None)) -> bool:
    """Whether two nested sayings are the same to the last bit, of some runs."""
    if isinstance(one, Tensor):
        return torch.equal(one[run], other[run])
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key], run) for key in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(same(a, b, run) for a, b in zip(one, other))
    return bool(one == other)


PARTS = ("env", "evaluation_env", "population", "individual", "buffers", "design_choice", "dynamics", "imagined")
GOVERNED: dict[str, Any] = {"governed": True, "states_are": "matched", "anchored": True, "sigma": 0.1}


def spoilt(algorithm: CoAdaptation, how: str) -> Iterator[Event]:
    """The events of an algorithm whose model is spoilt before each of them."""
    assert algorithm.dynamics is not None
    network = algorithm.dynamics.ensemble.network
    for event in algorithm:
        if how == "weights drawn anew":
            network.reset_parameters(torch.Generator().manual_seed(0))
        else:  # off by one standard deviation of a step's change
            bias = network.layers[-1].bias
            assert isinstance(bias, Tensor)
            with torch.no_grad():
                bias[..., : bias.shape[-1] // 2] += 1.0
        yield event


@pytest.mark.parametrize("settings", [{}, {"value_over": "visited", "value_states": "matched"}], ids=["", "visited"])
@pytest.mark.parametrize("num_runs", [1, 3])
@pytest.mark.parametrize("how", ["weights drawn anew", "off by one standard deviation"])
def test_a_governed_run_with_a_spoilt_model_is_the_model_free_baseline_to_the_last_bit(
    how: str, num_runs: int, settings: dict[str, Any]
) -> None:
    mixed = {"individual_mix": 0.2} | settings
    baseline = small(num_runs, imagine=False, **mixed)
    governed = small(num_runs, **GOVERNED, individual_imagined_share=0.2, **mixed)
    expected, events = list(baseline), list(spoilt(governed, how))
    assert same(told(expected), told(events))
    assert same(weights(baseline), weights(governed))
    assert all(event.imagined == 0 for event in events if isinstance(event, EpisodeDone))


@pytest.mark.parametrize("how", ["weights drawn anew", "off by one standard deviation"])
def test_an_ungoverned_run_with_a_spoilt_model_learns_something_else(how: str) -> None:
    baseline, ungoverned = small(imagine=False), small(sigma=0.1)
    list(baseline), list(spoilt(ungoverned, how))
    assert not same(weights(baseline), weights(ungoverned))


def with_errors(monkeypatch: pytest.MonkeyPatch, *errors: float) -> None:
    """Let the model's error be what is said of each run."""
    monkeypatch.setattr(DynamicsLearner, "error", lambda self, rows: torch.tensor(errors))


def test_runs_that_earn_it_imagine_and_the_others_are_the_baseline(monkeypatch: pytest.MonkeyPatch) -> None:
    with_errors(monkeypatch, 0.1, 0.9, 0.4)
    monkeypatch.setattr("coim.governor.AGREED", 0.0)
    baseline = small(3, imagine=False, batch_size=20, value_over="visited")
    governed = small(3, **GOVERNED, batch_size=20, value_over="visited")
    expected, events = list(baseline), list(governed)
    assert same(told(expected), told(events), slice(1, 2))
    assert same(weights(baseline), weights(governed), slice(1, 2))
    for run in (0, 2):
        assert not same(weights(baseline), weights(governed), slice(run, run + 1))
    shares = [event.metrics["imagined_share"].tolist() for event in events if isinstance(event, EpisodeDone)]
    assert shares == [pytest.approx([0.2, 0.0, 0.125])] * 7


def test_what_is_imagined_has_passed_the_governor(monkeypatch: pytest.MonkeyPatch) -> None:
    with_errors(monkeypatch, 0.1)
    governed = small(1, **GOVERNED, batch_size=20)

    def marked(imagined: TensorDictBase, real: TensorDictBase) -> TensorDictBase:
        assert len(real) > 1
        return imagined.set(("next", "reward"), torch.full_like(imagined["next", "reward"], 7.0))

    assert governed.imagined is not None
    monkeypatch.setattr(governed.imagined.governor, "agreeing", marked)
    for event in governed:
        if isinstance(event, EpisodeDone):
            assert (governed.buffers.art[:]["next", "reward"] == 7.0).all()


def test_batches_have_the_imagined_rows_that_each_run_has_earned(monkeypatch: pytest.MonkeyPatch) -> None:
    with_errors(monkeypatch, 0.1, 0.9, 0.4)
    monkeypatch.setattr("coim.governor.AGREED", 0.0)
    governed = small(3, **GOVERNED, batch_size=40)
    seen = []
    update = governed.population.update
    monkeypatch.setattr(
        governed.population, "update", lambda batches: (seen.append(batches["imagined"]), update(batches))[1]
    )
    list(governed)
    for imagined in seen:
        assert imagined.sum(1).squeeze(-1).tolist() == [[8, 0, 5]] * 2


@pytest.mark.parametrize("settings", [{}, {"states_are": "matched"}, {"anchored": True}], ids=str)
def test_the_share_of_impossible_pairs_is_counted_whatever_is_imagined(settings: dict[str, Any]) -> None:
    algorithm = small(3, sigma=0.5, batch_size=50, **settings)
    metrics = [event.metrics for event in algorithm if isinstance(event, EpisodeDone)]
    shares = torch.stack([found["impossible"] for found in metrics])
    assert shares.shape == (7, 3)
    assert ((shares >= 0) & (shares <= 1)).all()
    assert bool(shares.any()) is (settings.get("states_are") != "matched")


def test_the_share_that_is_told_is_that_of_the_learner_that_imagines_most(monkeypatch: pytest.MonkeyPatch) -> None:
    with_errors(monkeypatch, 0.4)
    monkeypatch.setattr("coim.governor.AGREED", 0.0)
    alone = small(1, **GOVERNED, imagined_share=0.0, individual_imagined_share=0.2, batch_size=20)
    shares = [event.metrics["imagined_share"].tolist() for event in alone if isinstance(event, EpisodeDone)]
    assert shares == [pytest.approx([0.125])] * 7


@pytest.mark.parametrize("learner", ["population", "individual"])
def test_a_governor_is_refused_where_the_share_decides_nothing(learner: str) -> None:
    parts = {name: value for name, value in vars(small(1, **GOVERNED)).items() if name in PARTS}
    parts[learner].loss.mix = "sum"
    with pytest.raises(ValueError, match="a governor sets the share of imagined rows, and with mix='sum' they count"):
        CoAdaptation(**parts)


def test_a_governed_run_that_is_interrupted_goes_on_as_it_would_have(monkeypatch: pytest.MonkeyPatch) -> None:
    with_errors(monkeypatch, 0.1, 0.9, 0.4)
    monkeypatch.setattr("coim.governor.AGREED", 0.0)
    whole = small(3, **GOVERNED, batch_size=20)
    expected = list(whole)
    begun, resumed = small(3, **GOVERNED, batch_size=20), small(3, **GOVERNED, batch_size=20)
    for event in begun:
        if isinstance(event, EpisodeDone) and event.index == 2:
            break
    file = io.BytesIO()
    torch.save(begun.state_dict(), file)
    file.seek(0)
    resumed.load_state_dict(torch.load(file, weights_only=True))
    rest = list(resumed)
    assert same(told(expected[-len(rest) :]), told(rest))
    assert same(weights(whole), weights(resumed))
    with pytest.raises(ValueError, match="one of the state and the algorithm is governed and the other is not"):
        small(3, sigma=0.1, batch_size=20).load_state_dict(begun.state_dict())


def asked_of_eq_5(monkeypatch: pytest.MonkeyPatch, **settings: Any) -> tuple[CoAdaptation, list[DesignValue]]:
    """An algorithm that has run, and each Eq. 5 that it has made."""
    made: list[DesignValue] = []

    def make(*args: Any, **kwargs: Any) -> DesignValue:
        made.append(DesignValue(*args, **kwargs))
        return made[-1]

    monkeypatch.setattr(design_choice, "DesignValue", make)
    algorithm = small(imagine=False, **settings)
    list(algorithm)
    return algorithm, made


def test_eq_5_averages_over_start_states_or_visited_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    algorithm, made = asked_of_eq_5(monkeypatch)
    starts = algorithm.buffers.s0[:]["observation"][:, 0]
    assert all(torch.isin(value.start_states["observation"], starts).all() for value in made)
    algorithm, made = asked_of_eq_5(monkeypatch, value_over="visited", num_start_states=30)
    visited = algorithm.buffers.pop[:]["observation"][:, 0]
    assert all(torch.isin(value.start_states["observation"], visited).all() for value in made)
    assert not any(torch.isin(value.start_states["observation"], starts).all() for value in made)


def test_eq_5_is_asked_about_matched_states_of_the_bodies_if_these_are_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    _, stored = asked_of_eq_5(monkeypatch)
    _, matched = asked_of_eq_5(monkeypatch, value_states="matched")
    design = torch.full((1, 4), 0.5)
    for value in matched:
        moved = HopperMorph().transfer(value.start_states["observation"], value.start_states["design"], design)
        seen = value._observed(value.start_states, design)
        torch.testing.assert_close(seen[0], moved)
    assert torch.equal(stored[0]._observed(stored[0].start_states, design)[0], stored[0].start_states["observation"])


def test_what_is_unknown_or_cannot_be_governed_is_named() -> None:
    for option in ("states_are", "actions", "value_states", "value_over"):
        with pytest.raises(ValueError, match=f"{option}='new' is unknown; choose "):
            small(**{option: "new"})
    with pytest.raises(ValueError, match="governed by the errors of the model that is learnt; give dynamics"):
        small(governed=True, dynamics=None)


def test_bodies_that_do_not_know_how_high_they_stand_are_not_counted_and_not_matched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def unknown(self: HopperMorph, observation: Tensor, design: Tensor) -> Tensor:
        raise ValueError("body_pos of this body is no affine function of its design")

    monkeypatch.setattr(HopperMorph, "clearance", unknown)
    episodes = [event for event in small(sigma=0.1) if isinstance(event, EpisodeDone)]
    assert len(episodes) == 7
    assert not any("impossible" in event.metrics for event in episodes)
    for option in ("states_are", "value_states"):
        with pytest.raises(ValueError, match="no affine function of its design"):
            small(**{option: "matched"})


def test_a_model_that_can_only_be_sampled_is_no_anchor() -> None:
    algorithm = small()

    class Sampler:
        def sample(self, observation: Tensor, action: Tensor, design: Tensor, *, generator: Any = None) -> Tensor:
            return observation

    dream = WorldModelEnv(Sampler(), algorithm.env, batch_size=[1])
    with pytest.raises(TypeError, match=r"a Sampler has no means\(\) to anchor with"):
        small(dream=dream, dynamics=None, anchored=True)


def test_a_run_from_before_there_were_such_counts_goes_on_without_them() -> None:
    begun, resumed = small(sigma=0.5), small(sigma=0.5)
    for event in begun:
        if isinstance(event, EpisodeDone):
            break
    state = begun.state_dict()
    del state["imagined"]
    resumed.load_state_dict(state)
    again = small(sigma=0.5)
    again.load_state_dict(resumed.state_dict())
    for algorithm in (resumed, again):
        episodes = [event for event in algorithm if isinstance(event, EpisodeDone)]
        assert len(episodes) == 6
        assert not any("impossible" in event.metrics for event in episodes)


def test_every_episode_of_a_governed_run_has_the_same_measurements() -> None:
    episodes = [event for event in small(3, **GOVERNED) if isinstance(event, EpisodeDone)]
    assert {*map(tuple, (event.metrics for event in episodes))} == {tuple(episodes[0].metrics)}
    assert {"impossible", "imagined_share", "model_error"} < episodes[0].metrics.keys()
