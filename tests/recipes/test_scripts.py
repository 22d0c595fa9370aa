"""The scripts that people copy run as they stand, and Algorithm 1 written out is `coim.CoAdaptation`."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable
from typing import Any

import pytest
import torch
from torchrl.data import Bounded

from coim import (
    Buffers,
    CoAdaptation,
    DesignChoice,
    DesignChosen,
    DesignDone,
    DynamicsLearner,
    EpisodeDone,
    Event,
    GaussianEnsemble,
    HopperMorph,
    ImaginedReplay,
    KnownDesigns,
    ParticleSwarm,
    SACLearner,
    UpdatePlan,
    WorldModelEnv,
    make_policy,
    make_qvalue,
)
from recipes import algorithm1, new_body, new_search, own_pipeline

COUNTS = {"num_designs": 8, "first_episodes": 2, "episodes": 2}
UPDATES = {"individual_updates": 6, "population_updates": 5, "model_updates": 4, "batch_size": 20}
SIZES: dict[str, Any] = {"num_cells": (8, 8), "model_cells": (9,)}
SWARM = {"num_particles": 6, "num_iterations": 3}
STEPS = 30


def algorithm(seed: int, *, imagined_share: float) -> CoAdaptation:
    """`recipes.algorithm1` with these sizes, put together from the same parts."""
    torch.manual_seed(seed)
    env, evaluation_env = (HopperMorph(episode_steps=STEPS, seed=seed + offset) for offset in (0, 1))
    population, individual = (
        SACLearner(make_policy(env, num_cells=(8, 8)), make_qvalue(env, num_cells=(8, 8)), seed=seed + offset)
        for offset in (0, 1)
    )
    capacities = {"pop_capacity": 1000, "ind_capacity": 100, "s0_capacity": 100, "art_capacity": 100}
    buffers = Buffers.for_env(env, **capacities, seed=seed)
    imagination: dict[str, Any] = {}
    if imagined_share:
        ensemble = GaussianEnsemble.for_env(env, num_cells=(9,))
        dream = WorldModelEnv(ensemble, env, batch_size=[1])
        imagination = {
            "dynamics": DynamicsLearner(ensemble),
            "imagined": ImaginedReplay(buffers.art, dream, KnownDesigns()),
        }
    return CoAdaptation(
        env,
        evaluation_env,
        population=population,
        individual=individual,
        buffers=buffers,
        design_choice=DesignChoice(
            env.design_spec,
            torch.tensor(HopperMorph.FIRST_DESIGNS),
            search=ParticleSwarm(env.design_spec, **SWARM, seed=seed),
            seed=seed,
        ),
        updates=UpdatePlan(**UPDATES, imagined_share=imagined_share),
        seed=seed,
        **imagination,
        **COUNTS,
    )


def lines_of(events: Iterable[Event]) -> list[str]:
    """What the script prints, from the events of the same algorithm."""
    lines, best = [], -torch.inf
    for event in events:
        if isinstance(event, DesignChosen):
            best = -torch.inf
            predicted = event.predicted
            expected = "no start state yet" if predicted is None else f"Eq. 5 is {predicted.item():.3f}"
            lines.append(f"design {event.index}: {[round(xi, 3) for xi in event.design[0].tolist()]}, {expected}")
        elif isinstance(event, EpisodeDone):
            achieved = event.evaluation_return.item()
            best = max(best, achieved)
            lines.append(f"design {event.index}, episode {event.episode}: return {achieved:.2f}, best {best:.2f}")
    return lines


@pytest.mark.parametrize("imagined_share", [0.2, 0.0])
def test_algorithm_1_written_out_computes_what_coadaptation_does(
    imagined_share: float, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[SACLearner | DynamicsLearner] = []  # population, individual, dynamics
    for kind in (SACLearner, DynamicsLearner):
        recorded = functools.partial(lambda kind, *args, **kwargs: made.append(kind(*args, **kwargs)) or made[-1], kind)
        monkeypatch.setattr(algorithm1, kind.__name__, recorded)
    best = algorithm1.main(
        **COUNTS, **UPDATES, **SIZES, **SWARM, episode_steps=STEPS, imagined_share=imagined_share, seed=3
    )
    printed = capsys.readouterr().out.splitlines()
    same = algorithm(3, imagined_share=imagined_share)
    events = list(same)
    assert printed == lines_of(events)
    assert sum("episode" in line for line in printed) == 8 * 2
    done = [event for event in events if isinstance(event, DesignDone)]
    assert best == pytest.approx([event.best_return.item() for event in done], rel=1e-6)
    learners = [same.population, same.individual, *([] if same.dynamics is None else [same.dynamics])]
    for own, other in zip(made, learners):
        assert all(torch.equal(a, b) for a, b in zip(own.weights_by_run(), other.weights_by_run()))


def test_a_body_of_ones_own_passes_torchrls_checks_and_is_trained(capsys: pytest.CaptureFixture[str]) -> None:
    returns = new_body.main(num_episodes=3, episode_steps=10, updates=2, batch_size=8, num_cells=(8,))
    assert len(returns) == 3
    assert [line.split(",")[0] for line in capsys.readouterr().out.splitlines()] == [
        "episode 0",
        "episode 1",
        "episode 2",
        *["after training"] * 3,
    ]


def test_the_crawler_is_what_its_table_says() -> None:
    env = new_body.Crawler(num_runs=3, reset_noise=0.0)
    designs = torch.tensor(new_body.Crawler.FIRST_DESIGNS)
    start = env.reset(env.full_state_spec.zero().set("design", designs))
    heights = 0.5 * designs[:, 1:].amax(1) + 0.05  # of the torso above the floor, m
    torch.testing.assert_close(start["observation"][:, 0], heights)
    torch.testing.assert_close(env.clearance(start["observation"], designs), torch.zeros(3, 1), rtol=0, atol=1e-6)
    lengths = [(part[:3] - part[3:6]).norm().item() for part in env.capsules(2)]
    assert lengths == pytest.approx([1.5 * 0.8, 0.8 * 0.5, 1.2 * 0.5])
    assert env.step_seconds == pytest.approx(0.02)
    faster = torch.zeros(9)
    faster[4] = 2.0  # m/s
    action = torch.tensor([1.0, 0.0])
    for task, reward in (("forward", 1.95), ("backward", -2.05)):
        found = new_body.Crawler.reward(torch.zeros(9), action, faster, torch.ones(3), task)  # type: ignore[arg-type]
        assert found.tolist() == pytest.approx([reward])


def test_algorithm_1_takes_a_body_of_ones_own(capsys: pytest.CaptureFixture[str]) -> None:
    counts = COUNTS | {"num_designs": 4, "first_episodes": 1, "episodes": 1}
    best = algorithm1.main(new_body.Crawler, **counts, **UPDATES, **SIZES, **SWARM, episode_steps=10)
    assert len(best) == 4
    assert "design 2: [1.5, 0.8, 1.2], Eq. 5 is" in capsys.readouterr().out


def test_a_search_of_ones_own_chooses_the_optimised_designs(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = []
    maximise = new_search.CrossEntropy.maximise

    def recorded(self: new_search.CrossEntropy, fitness: Any) -> Any:
        found.append(maximise(self, fitness))
        return found[-1]

    monkeypatch.setattr(new_search.CrossEntropy, "maximise", recorded)
    new_search.main(**COUNTS, **UPDATES, **SIZES, episode_steps=10)
    chosen = re.findall(r"design ([57]): (\[.*\]), Eq. 5 is (.*)", capsys.readouterr().out)
    assert chosen == [
        (str(index), str([round(xi, 3) for xi in design.tolist()]), f"{value:.3f}")
        for index, (design, value) in zip((5, 7), found)
    ]


def test_the_cross_entropy_method_finds_optima_inside_and_on_the_edge() -> None:
    spec = Bounded(low=torch.tensor([0.5, 1.0]), high=torch.tensor([2.0, 3.0]), shape=(2,))
    peak = torch.tensor([0.9, 4.0])
    design, value = new_search.CrossEntropy(spec, seed=0).maximise(lambda xi: -(xi - peak).square().sum(-1))
    torch.testing.assert_close(design, torch.tensor([0.9, 3.0]), rtol=0, atol=1e-2)
    assert value == pytest.approx(-1.0, abs=1e-3)


def test_the_cross_entropy_method_goes_on_with_the_draws_that_were_saved() -> None:
    spec = Bounded(low=0.5, high=2.0, shape=(3,))
    one, other = new_search.CrossEntropy(spec, seed=0), new_search.CrossEntropy(spec, seed=1)
    one.maximise(lambda xi: xi.sum(-1))
    other.load_state_dict(one.state_dict())
    seen: list[list[torch.Tensor]] = [[], []]
    for search, designs in zip((one, other), seen):
        search.maximise(lambda xi, designs=designs: (designs.append(xi), xi.sum(-1))[1])  # type: ignore[misc]
    assert all(torch.equal(a, b) for a, b in zip(*seen))


def test_torchrls_collector_and_trainer_train_with_our_loss(capsys: pytest.CaptureFixture[str]) -> None:
    sizes: dict[str, Any] = {"num_episodes": 4, "episode_steps": 20, "batch_size": 16, "num_cells": (8,)}
    trained = own_pipeline.main(**sizes, updates=20)
    lines = capsys.readouterr().out.splitlines()
    bodies = {line.split("design")[1].split(":")[0] for line in lines}
    assert len(lines) == len(bodies) == 4, "each episode has a body of its own"
    untrained = own_pipeline.main(**sizes, updates=0)
    assert trained[0] == untrained[0], "the first episode comes before the first update"
    assert trained[1:] != untrained[1:], "the collector acts with the weights that the trainer moves"
