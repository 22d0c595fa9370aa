"""A policy for all bodies as a yardstick: what each earns, and what is said of the arms of a study by it."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.stats import ttest_1samp

from benchmarks.yardstick import STUDY, Measured, earned, main, summary, tried
from coim import HopperMorph, load_run, run_episode
from tests.experiments.tiny_runs import run


def test_bodies_earn_what_the_population_earns_on_them_each_alone(tmp_path: Path) -> None:
    folder = run(tmp_path / "run", imagine="none", individual_updates=0, episode_steps=30)
    study = tmp_path / "study"
    for name in ("hopper-forward-grounded-20", "hopper-forward-none-21"):
        shutil.copytree(STUDY / "cells" / name, study / "cells" / name)
    shutil.copytree(STUDY / "retrained", study / "retrained")
    main(Measured(run=folder, study=study, out=tmp_path / "out", num_bodies=5, episodes=2))
    bodies = pd.read_csv(tmp_path / "out" / "bodies.csv")
    assert (bodies["arm"] == "uniform").sum() == 5
    assert (bodies["arm"] != "uniform").sum() == len(tried(study, "hopper")) == 40
    assert bodies["retrained"].notna().sum() == 1
    policy = load_run(folder).population.policy
    designs = torch.tensor(bodies.filter(like="xi_").to_numpy(), dtype=torch.float32)[:3]
    env = HopperMorph(num_runs=3, episode_steps=30, seed=0)
    both = [run_episode(env, policy, design=designs, deterministic=True)["next", "reward"].sum(0) for _ in range(2)]
    expected = torch.stack(both).mean(0).flatten().tolist()
    assert earned(HopperMorph(episode_steps=30), policy, designs, 2) == pytest.approx(expected, rel=1e-3)
    assert bodies["earned"][:3].tolist() == pytest.approx(expected, rel=1e-3)
    table = pd.read_csv(tmp_path / "out" / "summary.csv")
    assert table.columns.tolist() == ["arm", "measure", "mean", "low", "high", "runs", "revision", "episodes_learnt"]
    assert set(table["arm"]) == {"uniform", "grounded", "none", "all"}


def test_a_fleet_is_no_yardstick_and_a_study_of_other_bodies_has_nothing_to_measure(tmp_path: Path) -> None:
    folder = run(tmp_path / "fleet", num_runs=2, num_designs=2, first_episodes=1, imagine="none", episode_steps=8)
    with pytest.raises(ValueError, match="has 2 policies, a yardstick is one: --num-runs 1"):
        main(Measured(run=folder, out=tmp_path / "out"))
    with pytest.raises(ValueError, match="bodies has no run of walker; name a study of that body with --study"):
        tried(STUDY, "walker")
    assert not (tmp_path / "out").exists()


def test_arms_are_told_by_the_bodies_that_their_runs_found_best() -> None:
    rows = [{"arm": "uniform", "earned": value} for value in (1.0, 2.0, 9.0)]
    for seed, shift in ((0, 0.0), (1, 1.0), (2, 5.0)):
        for design in range(1, 7):
            kind = "first" if design == 1 else "optimised" if design % 2 else "random"
            best_return = {4: 100.0}.get(design, float(design))
            body = {"arm": "a", "seed": seed, "design": design, "kind": kind, "best_return": best_return}
            retrained = -float(design) if design == seed + 2 else np.nan
            rows.append(body | {"earned": design + shift, "retrained": retrained})
    found = summary(pd.DataFrame(rows)).set_index(["arm", "measure"])
    assert found.loc[("uniform", "best"), "mean"] == 9.0
    best = [4.0, 5.0, 9.0]  # what the fourth body earns in each run
    assert found.loc[("a", "best"), "mean"] == pytest.approx(6.0)
    interval = ttest_1samp(best, 0).confidence_interval()
    assert found.loc[("a", "best"), ["low", "high"]].tolist() == pytest.approx([interval.low, interval.high])
    assert found.loc[("a", "regret"), "mean"] == pytest.approx(3.0)
    assert found.loc[("a", "optimised"), "mean"] == pytest.approx(4.0 + 2.0)
    assert found.loc[("a", "random"), "mean"] == pytest.approx(4.0 + 2.0)
    assert found.loc[("all", "retrained"), "mean"] == pytest.approx(-1.0)
    assert found.loc[("a", "regret"), "runs"] == 3
