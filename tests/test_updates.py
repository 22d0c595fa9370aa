"""How much is learnt after an episode, and from which rows."""

from __future__ import annotations

import pytest
from small_algorithm import small

from coim import EpisodeDone, HopperMorph, UpdatePlan
from coim.batches import BatchParts
from coim.experiments.run.build import make_buffers, update_plan
from coim.experiments.run.settings import Settings


def test_the_papers_plan_draws_51_imagined_rows_in_each_of_250_batches() -> None:
    plan = UpdatePlan()
    assert plan.rows("population") == BatchParts(own=205, other=0, imagined=51)
    assert plan.rows("individual") == plan.rows("model") == BatchParts(own=256, other=0, imagined=0)
    assert plan.imagined_rows == 250 * 51


def test_individual_batches_count_among_the_imagined_rows() -> None:
    plan = UpdatePlan(individual_updates=3, population_updates=2, batch_size=10, individual_imagined_share=0.1)
    assert plan.imagined_rows == 3 * 1 + 2 * 2
    assert plan.without_imagination().imagined_rows == 1  # Replay_Art cannot have no room at all


def test_the_buffer_of_a_run_is_as_large_as_what_its_updates_draw() -> None:
    settings = Settings(num_designs=1, first_episodes=1, episode_steps=10, individual_imagined_share=0.1, batch_size=20)
    buffers = make_buffers(HopperMorph(episode_steps=10, seed=0), settings, seed=0)
    assert buffers.art.capacity == update_plan(settings).imagined_rows == 1000 * 2 + 250 * 4


def test_updates_are_those_of_the_learners_there_are() -> None:
    assert small().updates_per_episode == 3 + 2 + 2
    assert small(imagine=False).updates_per_episode == 3 + 2


def test_metrics_bear_the_names_of_their_learners() -> None:
    event = next(event for event in small() if isinstance(event, EpisodeDone))
    assert {name.split("/")[0] for name in event.metrics if "/" in name} == {"individual", "population", "model"}
    assert {"train individual", "train population", "train model"} < event.seconds.keys()


@pytest.mark.parametrize("count", [-1, 0.5, True])
def test_a_number_of_updates_that_cannot_be_is_named(count: float) -> None:
    with pytest.raises(ValueError, match="population_updates is"):
        UpdatePlan(population_updates=count)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["imagined_share", "individual_mix", "individual_imagined_share"])
@pytest.mark.parametrize("share", [-0.1, 2.0, float("nan")])
def test_a_share_that_cannot_be_is_named(name: str, share: float) -> None:
    with pytest.raises(ValueError, match=rf"{name} is {share}, it must lie in \[0, 1\]"):
        UpdatePlan(**{name: share})
