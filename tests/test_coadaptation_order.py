"""Algorithm 1 step by step: who acts, what is stored, who learns from what, and which networks choose the next body."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from small_algorithm import STEPS, small
from tensordict import TensorDict

from coim import (
    CoAdaptation,
    DesignChosen,
    DesignDone,
    DesignValue,
    EpisodeDone,
    coadaptation,
    design_choice,
    imagined_replay,
    updates,
)
from coim.batches import batch_parts


def traced(algorithm: CoAdaptation, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What the algorithm does from now on, a phrase for each step."""
    steps: list[str] = []
    whose = {id(algorithm.env): "training", id(algorithm.evaluation_env): "evaluation"}
    whose |= {id(algorithm.population.policy): "Pop", id(algorithm.individual.policy): "Ind"}
    whose |= {id(getattr(algorithm.buffers, name)): name for name in ("pop", "ind", "s0", "art")}

    def spy(owner: Any, name: str, phrase: Callable[..., str]) -> None:
        original = getattr(owner, name)

        def spied(*args: Any, **kwargs: Any) -> Any:
            steps.append(phrase(*args, **kwargs))
            return original(*args, **kwargs)

        monkeypatch.setattr(owner, name, spied)

    def episode(
        env: Any, policy: Any, *, design: Any, native: bool, deterministic: bool = False, rng: Any = None
    ) -> str:
        assert not native
        return f"{whose[id(env)]} episode with {'the mode' if deterministic else 'a sample'} of pi_{whose[id(policy)]}"

    def mixture(sources: Any, num_batches: int, *, imagined: Any = None, rng: Any = None) -> str:
        parts = " + ".join(f"{rows} {whose[id(buffer)]}" for buffer, rows in sources if rows)
        return f"{num_batches} batches of {parts}" + (", art marked" if imagined is algorithm.buffers.art else "")

    spy(coadaptation, "run_episode", episode)
    spy(updates, "sample_mixture", mixture)
    spy(
        imagined_replay,
        "imagine",
        lambda dream, states, policy, *a, **k: f"imagine {len(states)} with pi_{whose[id(policy)]}",
    )
    for name in ("pop", "ind", "s0", "art"):
        buffer = getattr(algorithm.buffers, name)
        spy(buffer, "extend", lambda rows, name=name, **k: f"{len(rows)} rows into {name}")
        spy(buffer, "empty", lambda name=name, **k: f"empty {name}")
    spy(algorithm.buffers.pop, "sample", lambda number: f"{number} states of pop")
    for name in ("individual", "population", "dynamics"):
        learner = getattr(algorithm, name)
        if learner is not None:
            spy(learner, "update", lambda batches, name=name: f"{len(batches)} updates of {name}")
    spy(algorithm.individual, "start_from", lambda other: f"Ind = {whose[id(other.policy)]}")
    if algorithm.dynamics is not None:
        spy(algorithm.dynamics, "observe", lambda rows: f"count {len(rows)} rows")
    return steps


REFRESH = ["empty art", "4 states of pop", "imagine 4 with pi_Pop", "4 rows into art"]


def test_a_design_follows_algorithm_1_step_by_step(monkeypatch: pytest.MonkeyPatch) -> None:
    algorithm = small(first_episodes=1, num_designs=2)
    events = iter(algorithm)
    while not isinstance(next(events), DesignDone):
        pass
    steps = traced(algorithm, monkeypatch)
    assert [type(event) for event in events] == [DesignChosen, EpisodeDone, DesignDone]
    assert steps == [
        "Ind = Pop",
        "empty ind",
        *REFRESH,
        "training episode with a sample of pi_Ind",
        f"{STEPS} rows into ind",
        f"{STEPS} rows into pop",
        f"count {STEPS} rows",
        *REFRESH,
        "1 rows into s0",
        "3 batches of 10 ind, art marked",
        "3 updates of individual",
        "2 batches of 8 pop + 2 art, art marked",
        "2 updates of population",
        "2 batches of 10 pop, art marked",
        "2 updates of dynamics",
        "evaluation episode with the mode of pi_Ind",
    ]


def test_the_baseline_takes_the_same_steps_without_imagination(monkeypatch: pytest.MonkeyPatch) -> None:
    algorithm = small(imagine=False, first_episodes=1, num_designs=1)
    steps = traced(algorithm, monkeypatch)
    list(algorithm)
    assert steps == [
        "Ind = Pop",
        "empty ind",
        "empty art",
        "training episode with a sample of pi_Ind",
        f"{STEPS} rows into ind",
        f"{STEPS} rows into pop",
        "empty art",
        "1 rows into s0",
        "3 batches of 10 ind, art marked",
        "3 updates of individual",
        "2 batches of 10 pop, art marked",
        "2 updates of population",
        "evaluation episode with the mode of pi_Ind",
    ]


def test_shares_of_an_individual_batch_come_from_pop_and_art(monkeypatch: pytest.MonkeyPatch) -> None:
    algorithm = small(first_episodes=1, num_designs=1, individual_mix=0.3, individual_imagined_share=0.1)
    steps = traced(algorithm, monkeypatch)
    list(algorithm)
    assert "3 batches of 6 ind + 3 pop + 1 art, art marked" in steps
    assert "7 rows into art" in steps  # three for the individual, two times two for the population


@pytest.mark.parametrize("num_runs", [1, 3])
def test_each_run_chooses_its_body_by_the_population_and_its_own_start_states(
    num_runs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    algorithm = small(num_runs, first_episodes=1, num_designs=3)
    asked: list[TensorDict] = []

    class Recorded(DesignValue):
        def __init__(self, policy: Any, qvalue: Any, start_states: TensorDict, **kwargs: Any) -> None:
            super().__init__(policy, qvalue, start_states, **kwargs)
            asked.append(start_states)

    events = iter(algorithm)
    for event in events:
        if isinstance(event, DesignDone) and event.index == 1:
            break
    worth = torch.arange(5.0, 5.0 + num_runs)
    with torch.no_grad():
        for learner, sign in ((algorithm.population, 1), (algorithm.individual, -1)):
            last = learner.qvalue.module.mlp.layers[-1]
            last.weight.zero_()
            last.bias.copy_((sign * worth).view(*last.bias.shape[:-2], 1, 1).expand_as(last.bias))
    monkeypatch.setattr(design_choice, "DesignValue", Recorded)
    chosen = next(events)
    assert isinstance(chosen, DesignChosen)
    assert chosen.kind == "optimised"
    assert chosen.predicted is not None
    assert chosen.predicted.tolist() == worth.tolist()
    seen = algorithm.buffers.s0[:]["observation"]
    assert len(asked) == num_runs
    for run, states in enumerate(asked):
        assert len(states) == 4
        assert all((row == seen[:, run]).all(-1).any() for row in states["observation"])


def test_the_best_return_is_that_of_the_best_evaluation_and_training_returns_do_not_count(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    returns = iter([90.0, 7.0, 80.0, 9.0, 70.0, 8.0])  # training and evaluation in turn
    monkeypatch.setattr(coadaptation, "episode_return", lambda rows: torch.tensor([next(returns)]))
    events = list(small(first_episodes=3, num_designs=1))
    assert [e.evaluation_return.item() for e in events if isinstance(e, EpisodeDone)] == [7.0, 9.0, 8.0]
    assert events[-1].best_return.item() == 9.0  # type: ignore[union-attr]


def test_metrics_are_means_over_all_updates(monkeypatch: pytest.MonkeyPatch) -> None:
    algorithm = small(first_episodes=1, num_designs=1)
    monkeypatch.setattr(updates, "UPDATES_PER_SAMPLE", 2)
    answers = {2: 1.0, 1: 4.0}  # three updates in two calls
    monkeypatch.setattr(
        algorithm.individual,
        "update",
        lambda batches: TensorDict({"loss_actor": torch.tensor([answers[len(batches)]])}),
    )
    done = next(event for event in algorithm if isinstance(event, EpisodeDone))
    assert float(done.metrics["individual/loss_actor"]) == pytest.approx(2.0)  # (1 + 1 + 4) / 3


def test_who_stops_after_a_design_goes_on_with_the_next() -> None:
    algorithm = small(num_designs=3, first_episodes=1)
    for event in algorithm:
        if isinstance(event, DesignDone):
            break
    assert [event.index for event in algorithm if isinstance(event, DesignDone)] == [1, 2]


@pytest.mark.parametrize("shares", [{"imagined": 0.2}, {"other": 0.2}, {"imagined": 0.9}])
def test_a_batch_smaller_than_its_parts_is_refused(shares: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="a batch of 2 rows is smaller than its parts"):
        batch_parts(2, **shares)
    assert batch_parts(2, imagined=1.0).imagined == 2
    assert batch_parts(2, imagined=0.5, other=0.5).own == 0


def test_no_draw_repeats_the_last_one(monkeypatch: pytest.MonkeyPatch) -> None:
    algorithm = small(num_designs=6, individual_updates=2)
    monkeypatch.setattr(updates, "UPDATES_PER_SAMPLE", 1)
    update, batches = algorithm.individual.update, []
    monkeypatch.setattr(
        algorithm.individual, "update", lambda rows: (batches.append(rows["observation"]), update(rows))[1]
    )
    designs = [event.design for event in algorithm if isinstance(event, DesignDone) and event.kind == "random"]
    assert not torch.equal(*designs)
    assert not torch.equal(batches[0], batches[1])
    first, second = algorithm.buffers.pop[:]["action"][: 2 * STEPS].split(STEPS)  # two episodes of one body
    assert (first - second).abs().mean() > 0.1


def test_the_steps_of_a_fleet_are_those_of_one_run() -> None:
    algorithm = small(3, num_designs=1, first_episodes=2)
    assert [event.env_steps for event in algorithm if isinstance(event, EpisodeDone)] == [STEPS, 2 * STEPS]


def test_every_refresh_imagines_with_fresh_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    algorithm = small(sigma=0.1, num_designs=1)  # two episodes of the unit body
    designs: list[torch.Tensor] = []
    extend = algorithm.buffers.art.extend
    monkeypatch.setattr(algorithm.buffers.art, "extend", lambda rows: (designs.append(rows["design"]), extend(rows))[1])
    list(algorithm)
    assert not torch.equal(*designs)
