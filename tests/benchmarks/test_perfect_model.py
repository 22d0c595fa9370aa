"""Runs with the simulator in the model's place at sizes of seconds: what is imagined, and what is measured."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from benchmarks import perfect_model
from benchmarks.perfect_model import ARMS, PILOT, SIMULATED_ROWS, Comparison, FewBodies, imagining, main, summarise
from coim import EpisodeDone, HopperMorph, Policy, WorldModelEnv, imagine, imagined_replay

TINY = dataclasses.replace(
    PILOT,
    num_designs=7,
    first_episodes=1,
    episodes=1,
    episode_steps=6,
    individual_updates=2,
    population_updates=2,
    batch_size=10,
    num_cells=(8,),
    num_start_states=3,
    compile=False,
    native_episodes=False,
)


def test_every_arm_is_run_once_and_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = Comparison(out=tmp_path, seeds=(0, 1), sizes=TINY)
    main(asked)
    rows = pd.read_csv(tmp_path / "bodies.csv")
    assert rows.groupby(["arm", "seed"]).size().to_dict() == {(arm, seed): 7 for arm in ARMS for seed in (0, 1)}
    assert {*rows["kind"]} == {"first", "optimised", "random"}
    found = pd.read_csv(tmp_path / "summary.csv").set_index(["arm", "measure"])
    area = rows.groupby(["arm", "seed"])["best_return"].mean()
    expected = (area["random"] - area["none"]).mean()
    assert found.loc[("random", "area"), "difference"] == pytest.approx(expected, rel=1e-4)
    assert (tmp_path / "bodies.png").stat().st_size > 10_000
    before = (tmp_path / "bodies.csv").read_bytes()
    monkeypatch.setattr(perfect_model, "build", None)
    main(asked)
    assert (tmp_path / "bodies.csv").read_bytes() == before
    (tmp_path / "bodies.csv").write_bytes(before[: before.rindex(b"own,1,7")])
    with pytest.raises(ValueError, match=r"has 6 rows of own with seed 1, and a run has 7 bodies; delete these rows"):
        main(asked)


def test_seeds_that_one_arm_lacks_are_not_compared() -> None:
    returns = {("none", 0): 1.0, ("none", 1): 5.0, ("own", 0): 4.0}
    rows = [
        {"arm": arm, "seed": seed, "design": 1, "kind": "first", "best_return": value}
        for (arm, seed), value in returns.items()
    ]
    found = summarise(pd.DataFrame(rows)).set_index(["arm", "measure"])
    assert found.loc[("own", "area"), "difference"] == 3.0
    assert found.loc[("none", "area"), "mean"] == 3.0


def test_the_interval_of_the_differences_is_students() -> None:
    returns = {"none": (1.0, 2.0, 5.0), "random": (2.0, 4.0, 8.0)}
    rows = [
        {"arm": arm, "seed": seed, "design": 1, "kind": "first", "best_return": value}
        for arm, values in returns.items()
        for seed, value in enumerate(values)
    ]
    found = summarise(pd.DataFrame(rows)).set_index(["arm", "measure"]).loc[("random", "area")]
    assert found[["pairs", "difference"]].tolist() == [3, 2.0]
    assert found[["low", "high"]].tolist() == pytest.approx([2 - 2.4841, 2 + 2.4841], abs=1e-4)  # 4.3027 / sqrt(3)
    assert found["p"] == pytest.approx(0.0742, abs=1e-4)


def test_without_runs_that_imagine_nothing_there_is_no_difference() -> None:
    rows = pd.DataFrame([{"arm": "own", "seed": 0, "design": 1, "kind": "first", "best_return": 4.0}])
    assert summarise(rows)["difference"].isna().all()


def test_random_bodies_are_as_many_as_the_simulator_has() -> None:
    spec = HopperMorph(seed=0).design_spec
    designs = FewBodies(spec)(torch.ones(4 * SIMULATED_ROWS + 100, 1, 4), rng=torch.Generator().manual_seed(0))
    assert len(designs.unique(dim=0)) == SIMULATED_ROWS
    assert torch.equal(designs[:SIMULATED_ROWS], designs[3 * SIMULATED_ROWS : 4 * SIMULATED_ROWS])
    assert spec.is_in(designs[0, 0])


@pytest.mark.parametrize("arm", ["random", "own"])
def test_what_is_imagined_is_the_simulators_own_step(arm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(perfect_model, "ROWS", 3)
    monkeypatch.setattr(perfect_model, "SIMULATED_ROWS", 2)
    settings = dataclasses.replace(TINY, num_designs=2, episode_steps=12, **ARMS[arm])
    algorithm = imagining(settings, own=arm == "own")
    policies = []

    def noted(dream: WorldModelEnv, states: TensorDictBase, policy: Policy, *args: Any, **options: Any) -> TensorDict:
        policies.append(policy)
        return imagine(dream, states, policy, *args, **options)

    monkeypatch.setattr(imagined_replay, "imagine", noted)
    for event in algorithm:
        if not isinstance(event, EpisodeDone):
            continue
        assert len(algorithm.buffers.art) == 3
        rows = algorithm.buffers.art.storage[: len(algorithm.buffers.art)].reshape(-1)
        if arm == "random":
            assert len(rows["design"].unique(dim=0)) == 2
        else:
            assert torch.equal(rows["design"], event.design.expand_as(rows["design"]))
        env = HopperMorph(num_runs=len(rows), seed=3)
        env.place(rows["observation"], rows["design"])
        after, _ = env.move(rows["action"])
        torch.testing.assert_close(rows["next", "observation"], after, rtol=0, atol=1e-4)
    learner = algorithm.individual if arm == "own" else algorithm.population
    assert policies
    assert all(policy is learner.policy for policy in policies)
