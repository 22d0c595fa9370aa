"""The learning-curve recipe on a toy scale: what it writes, and that it goes on where it stopped."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
import torch

from benchmarks import learning_curve
from benchmarks.learning_curve import Curve, main, read
from coim import EpisodeDone
from coim.experiments.run.settings import Settings


@pytest.fixture
def fast(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Arms that return their seed plus the episode, and a log of what was run."""
    ran: list[tuple[str, int]] = []

    def returns(arm: str, settings: object, episodes: int) -> list[list]:
        seed = settings.seed  # type: ignore[attr-defined]
        ran.append((arm, seed))
        return [[arm, seed, i + 1, 10 * seed + i] for i in range(episodes)]

    monkeypatch.setattr(learning_curve, "returns", returns)
    monkeypatch.setattr(learning_curve, "random_returns", lambda curve: [1.0, 3.0])
    return ran


def test_the_summary_holds_means_minima_and_ratios_to_the_random_policy(tmp_path: Path, fast: list) -> None:
    main(Curve(out=tmp_path, seeds=(1, 3), episodes=4))
    with (tmp_path / "summary.csv").open(newline="") as file:
        model_free = next(csv.DictReader(file))
    assert model_free["arm"] == "model-free"
    assert float(model_free["return_last_episode_mean"]) == 23.0
    assert float(model_free["return_last_episode_min"]) == 13.0
    assert float(model_free["times_random_mean"]) == 11.5
    assert (tmp_path / "curves.png").stat().st_size > 10_000


def test_what_is_there_is_not_run_again(tmp_path: Path, fast: list) -> None:
    main(Curve(out=tmp_path, seeds=(0,), episodes=2))
    before = len(fast)
    main(Curve(out=tmp_path, seeds=(0, 1), episodes=2))
    assert fast[before:] == [("model-free", 1), ("known designs imagined", 1)]
    assert (read(tmp_path / "curves.csv")["arm"] == "random policy").sum() == 2


def test_a_run_that_diverges_keeps_the_return_of_its_frozen_policy(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Else the curve of the whole arm would end where that of one seed does."""
    nothing = torch.zeros(1)
    done = EpisodeDone(0, "first", 0, torch.ones(1, 7), nothing, torch.tensor([4.0]), 1000, 0, {}, {"episode": 1.0})
    monkeypatch.setattr(learning_curve, "build", lambda *args, **kwargs: [done])
    rows = learning_curve.returns("model-free", Settings(seed=3), 3)
    assert rows == [["model-free", 3, episode, "4"] for episode in (1, 2, 3)]
    assert "model-free, seed 3 diverged: its frozen policy's return stands for 2 episode(s)" in capsys.readouterr().out
