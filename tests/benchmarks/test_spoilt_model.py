"""Learning with a spoilt model at sizes of seconds: what is measured, and that a governed run is the baseline."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pandas as pd
import pytest
import torch

from benchmarks import spoilt_model
from benchmarks.spoilt_model import ARMS, NONE, SIZES, Comparison, SpoiltModel, main, summarise
from coim import DynamicsLearner, GaussianEnsemble, HopperMorph

TINY = dataclasses.replace(
    SIZES,
    num_runs=2,
    num_designs=1,
    first_episodes=2,
    episode_steps=6,
    individual_updates=2,
    population_updates=2,
    model_updates=2,
    batch_size=10,
    num_cells=(8,),
    model_cells=(8,),
    compile=False,
)


def test_governed_runs_are_the_baseline_and_what_is_there_is_not_run_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    main(Comparison(out=tmp_path, seeds=(0,), sizes=TINY))
    found = pd.read_csv(tmp_path / "summary.csv").set_index("arm")
    assert found.index.tolist() == [*ARMS]
    for name in ARMS:
        imagines = name != NONE and "governed" not in name
        assert (found.loc[name, "same_as_baseline"] == 2) is not imagines
    assert (found["largest_share"].dropna() == 0).all()
    assert (tmp_path / "curves.png").stat().st_size > 10_000
    before = (tmp_path / "curves.csv").read_bytes()
    monkeypatch.setattr(spoilt_model, "build", None)
    main(Comparison(out=tmp_path, seeds=(0,), sizes=TINY))
    assert (tmp_path / "curves.csv").read_bytes() == before


def test_an_arm_lies_within_the_baseline_or_not() -> None:
    values = {NONE: (1.0, 3.0), "off by one, governed": (1.0, 3.0), "off by one": (0.0, 0.5)}
    rows = [
        {"arm": name, "seed": 0, "run": run, "return": value, "imagined_share": 0.0}
        for name, own in values.items()
        for run, value in enumerate(own)
    ]
    found = summarise(pd.DataFrame(rows)).set_index("arm")
    assert found["within_baseline"].to_dict() == {NONE: "yes", "off by one, governed": "yes", "off by one": "no"}
    assert found.loc["off by one", "difference"] == -1.75


@pytest.mark.parametrize("how", ["weights drawn anew", "off by one deviation"])
def test_a_spoilt_model_foresees_nothing_however_much_it_learns(how: spoilt_model.Spoilt) -> None:
    torch.manual_seed(0)
    env = HopperMorph(seed=0)
    learner = DynamicsLearner(GaussianEnsemble.for_env(env, num_cells=(32,)), lr=1e-2)
    rows = env.rollout(100).reshape(-1)
    learner.observe(rows)
    batches = rows.expand(200, 100)  # as many updates
    learner.update(batches)
    sound = float(learner.error(rows))
    SpoiltModel(learner, how, seed=0)
    learner.update(batches)
    assert sound < 0.6
    assert float(learner.error(rows)) > 0.9
