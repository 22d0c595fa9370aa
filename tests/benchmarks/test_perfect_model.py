"""Runs with the simulator in the model's place at sizes of seconds: what is imagined, and what is measured."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pandas as pd
import pytest
import torch

from benchmarks import perfect_model
from benchmarks.perfect_model import ARMS, PILOT, Comparison, FewBodies, imagining, main, summarise
from coim import EpisodeDone, HopperMorph

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
    assert found.loc[("random", "area"), "low"] <= expected <= found.loc[("random", "area"), "high"]
    assert (tmp_path / "bodies.png").stat().st_size > 10_000
    before = (tmp_path / "bodies.csv").read_bytes()
    monkeypatch.setattr(perfect_model, "build", None)
    main(asked)
    assert (tmp_path / "bodies.csv").read_bytes() == before


def test_seeds_that_one_arm_lacks_are_not_compared() -> None:
    returns = {("none", 0): 1.0, ("none", 1): 5.0, ("own", 0): 4.0}
    rows = [
        {"arm": arm, "seed": seed, "design": 1, "kind": "first", "best_return": value}
        for (arm, seed), value in returns.items()
    ]
    found = summarise(pd.DataFrame(rows)).set_index(["arm", "measure"])
    assert found.loc[("own", "area"), "difference"] == 3.0
    assert found.loc[("none", "area"), "mean"] == 3.0


def test_random_bodies_are_as_many_as_the_simulator_has() -> None:
    spec = HopperMorph(seed=0).design_spec
    designs = FewBodies(spec)(torch.ones(1_100, 1, 4), rng=torch.Generator().manual_seed(0))
    assert len(designs.unique(dim=0)) == 250
    assert torch.equal(designs[:250], designs[750:1000])
    assert spec.is_in(designs[0, 0])


@pytest.mark.parametrize("arm", ["random", "own"])
def test_what_is_imagined_is_the_simulators_own_step(arm: str) -> None:
    settings = dataclasses.replace(TINY, num_designs=2, episode_steps=12, **ARMS[arm])
    algorithm = imagining(settings, own=arm == "own")
    for event in algorithm:
        if not isinstance(event, EpisodeDone):
            continue
        rows = algorithm.buffers.art.storage[: len(algorithm.buffers.art)].reshape(-1)
        if arm == "own":
            assert torch.equal(rows["design"], event.design.expand_as(rows["design"]))
        env = HopperMorph(num_runs=len(rows), seed=3)
        env.place(rows["observation"], rows["design"])
        after, _ = env.move(rows["action"])
        torch.testing.assert_close(rows["next", "observation"], after, rtol=0, atol=1e-4)
