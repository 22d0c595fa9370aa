"""Algorithm 1: the order of its steps, what fills its buffers, and what bad settings get."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from small_algorithm import STEPS, small

from coim import (
    DesignChosen,
    DesignDone,
    EpisodeDone,
    HopperMorph,
)
from coim.batches import BatchParts


def test_events_follow_the_protocol() -> None:
    events = list(small())
    chosen = [event for event in events if isinstance(event, DesignChosen)]
    episodes = [event for event in events if isinstance(event, EpisodeDone)]
    done = [event for event in events if isinstance(event, DesignDone)]
    assert [event.kind for event in chosen] == ["first", "first", "optimised", "random", "optimised"]
    assert [(event.index, event.episode) for event in episodes] == [
        (0, 0),
        (0, 1),
        (1, 0),
        (1, 1),
        (2, 0),
        (3, 0),
        (4, 0),
    ]
    assert [event.env_steps for event in episodes] == [STEPS * (i + 1) for i in range(7)]
    for event in done:
        best = max(float(e.evaluation_return) for e in episodes if e.index == event.index)
        assert float(event.best_return) == pytest.approx(best)
    assert chosen[0].predicted is None
    assert all(event.predicted is not None for event in chosen[1:])


def test_first_designs_are_those_given_and_later_ones_lie_in_the_bounds() -> None:
    algorithm = small()
    chosen = [event for event in algorithm if isinstance(event, DesignChosen)]
    assert torch.equal(chosen[1].design[0], torch.tensor(HopperMorph.FIRST_DESIGNS[1]))
    assert all(algorithm.env.design_spec.is_in(event.design[0]) for event in chosen)
    assert not torch.equal(chosen[2].design, chosen[4].design)


def test_random_bodies_are_never_searched_for() -> None:
    algorithm = small(bodies="random")
    algorithm.design_choice.search.maximise = None  # type: ignore[union-attr, assignment]
    chosen = [event for event in algorithm if isinstance(event, DesignChosen)]
    assert [event.kind for event in chosen] == ["first", "first", "random", "random", "random"]
    assert len({tuple(event.design[0].tolist()) for event in chosen}) == 5


def test_a_fixed_body_takes_the_place_of_every_design_with_the_same_budget() -> None:
    algorithm = small(bodies="fixed", imagine=False)
    events = list(algorithm)
    chosen = [event for event in events if isinstance(event, DesignChosen)]
    assert [event.kind for event in chosen] == ["fixed"] * 5
    assert all(torch.equal(event.design, torch.ones(1, 4)) for event in chosen)
    assert [event.env_steps for event in events if isinstance(event, EpisodeDone)][-1] == 7 * STEPS


def test_buffers_after_a_run() -> None:
    algorithm = small()
    last = [event for event in algorithm if isinstance(event, EpisodeDone)][-1]
    buffers = algorithm.buffers
    assert len(buffers.pop) == 7 * STEPS
    assert len(buffers.s0) == 7
    assert len(buffers.ind) == STEPS  # emptied when the last design began
    assert torch.equal(buffers.ind[:]["design"][:, 0], last.design.expand(STEPS, -1))
    assert len(buffers.art) == 2 * 2  # one row for each imagined row of the population's two batches of 8 + 2
    # With G the identity every imagined row has a state of Replay_Pop with its own design.
    seen = torch.cat([buffers.pop[:]["observation"], buffers.pop[:]["design"]], -1)[:, 0]
    dreamt = torch.cat([buffers.art[:]["observation"], buffers.art[:]["design"]], -1)[:, 0]
    assert all((row == seen).all(-1).any() for row in dreamt)


def test_start_states_are_the_first_rows_of_the_episodes() -> None:
    algorithm = small(first_episodes=1, num_designs=2)
    list(algorithm)
    rows = algorithm.buffers.pop[:]
    starts = algorithm.buffers.s0[:]
    assert torch.equal(starts["observation"], rows["observation"][[0, STEPS]])


def test_the_individual_starts_each_design_from_the_population() -> None:
    algorithm = small()
    for event in algorithm:
        if isinstance(event, DesignChosen):
            population = {k: v.clone() for k, v in algorithm.population.loss.state_dict().items()}
        if isinstance(event, EpisodeDone) and event.episode == 0:
            individual = algorithm.individual.loss.state_dict()
            moved = max(float((individual[key] - value).abs().max()) for key, value in population.items())
            assert 0 < moved < 3.1 * 3e-4  # three Adam steps from there


def test_without_imagination_nothing_is_imagined_and_no_model_is_trained() -> None:
    algorithm = small(imagine=False)
    episodes = [event for event in algorithm if isinstance(event, EpisodeDone)]
    assert all(event.imagined == 0 for event in episodes)
    assert not any("model" in key for event in episodes for key in event.metrics)
    assert algorithm.training.plan.rows("population") == BatchParts(own=10, other=0, imagined=0)


def test_noisy_designs_are_imagined_but_never_stored_as_real() -> None:
    algorithm = small(sigma=0.1, num_designs=2)
    list(algorithm)
    assert {tuple(row) for row in algorithm.buffers.pop[:]["design"][:, 0].tolist()} <= {
        tuple(torch.tensor(design).tolist()) for design in HopperMorph.FIRST_DESIGNS
    }
    assert len(algorithm.buffers.art[:]["design"].unique(dim=0)) == len(algorithm.buffers.art)


def test_the_same_seed_gives_the_same_events() -> None:
    first, second = ([event.evaluation_return for event in small() if isinstance(event, EpisodeDone)] for _ in range(2))
    assert torch.equal(torch.stack(first), torch.stack(second))


def test_a_run_does_not_depend_on_the_defaults_of_torch() -> None:
    expected, algorithm = list(small(num_designs=4)), small(num_designs=4)
    usual = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        with torch.device("meta"):  # a tensor that is made on the default device has no numbers
            events = list(algorithm)
    finally:
        torch.set_default_dtype(usual)
    for event, other in zip(events, expected, strict=True):
        if isinstance(event, EpisodeDone):
            assert torch.equal(event.evaluation_return, other.evaluation_return)
            assert event.evaluation_return.dtype == torch.float32
        assert torch.equal(event.design, other.design)


@pytest.mark.parametrize(
    "shares", [{}, {"individual_mix": 0.2, "individual_imagined_share": 0.3}], ids=["paper", "mixed"]
)
def test_side_by_side_is_one_after_the_other_to_the_last_bit(shares: dict[str, float]) -> None:
    together, apart = (small(num_designs=4, side_by_side=together, **shares) for together in (True, False))
    for event, expected in zip(together, apart, strict=True):
        if isinstance(event, EpisodeDone):
            assert torch.equal(event.evaluation_return, expected.evaluation_return)
            assert all(torch.equal(event.metrics[key], expected.metrics[key]) for key in expected.metrics)
    for learner, other in ((together.population, apart.population), (together.individual, apart.individual)):
        for key, value in other.loss.state_dict().items():
            assert torch.equal(learner.loss.state_dict()[key], value), key


def test_the_runs_of_a_fleet_get_bodies_of_their_own() -> None:
    algorithm = small(3)
    events = list(algorithm)
    chosen = [event for event in events if isinstance(event, DesignChosen)]
    assert chosen[0].design.shape == (3, 4)
    assert torch.equal(chosen[0].design[0], chosen[0].design[2])
    for event in chosen[2:]:
        assert len(event.design.unique(dim=0)) == 3
    assert events[-1].best_return.shape == (3,)
    assert algorithm.buffers.pop[:].batch_size == (7 * STEPS, 3)


def test_nothing_of_one_run_reaches_another() -> None:
    """Run 0 ends with the same replay whatever the weights of run 1 are, as long as it finds the same designs."""

    def rows_of_run_0(scale: float) -> torch.Tensor:
        algorithm = small(2, num_designs=2)
        with torch.no_grad():
            for learner in (algorithm.population, algorithm.individual):
                for parameter in learner.loss.parameters():
                    parameter[1] *= scale
        list(algorithm)
        return algorithm.buffers.pop[:]["observation"][:, 0]

    torch.testing.assert_close(rows_of_run_0(1.0), rows_of_run_0(0.5), rtol=0, atol=1e-4)


def test_a_caller_can_stop_at_any_event() -> None:
    algorithm = small()
    for event in algorithm:
        if isinstance(event, EpisodeDone):
            break
    assert len(algorithm.buffers.pop) == STEPS


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"num_designs": 0}, "num_designs is 0, it must be at least 1"),
        ({"individual_updates": -1}, "individual_updates is -1"),
        ({"imagined_share": 1.2}, r"share is 1.2, it must lie in \[0, 1\]"),
        ({"individual_mix": 0.7, "individual_imagined_share": 0.6}, "need 13"),
        ({"first_designs": torch.ones(2, 3)}, r"first_designs has shape \[2, 3\], expected \[I, 4\]"),
        ({"first_designs": torch.full((1, 4), 3.0)}, r"has 3 as its entry 1 of 4, which must lie in \[0.5, 2\]"),
        ({"bodies": "serach"}, "bodies='serach' is unknown; choose 'search', 'random' or 'fixed'"),
    ],
)
def test_bad_settings_get_a_sentence_before_anything_is_computed(settings: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        small(**settings)
