"""A run's CSV files, row by row."""

from __future__ import annotations

import csv
from pathlib import Path

import torch

from coim import EpisodeDone
from recipes.results import Results
from recipes.settings import Settings


def test_seconds_stand_under_their_part_whichever_learner_ends_first(tmp_path: Path) -> None:
    results = Results(tmp_path / "run", "hopper", Settings(), design_size=4)
    for episode, parts in enumerate(
        (("train individual", "train population"), ("train population", "train individual"))
    ):
        booked = {part: 1.0 if part == "train individual" else 2.0 for part in parts}
        event = EpisodeDone(
            index=0,
            kind="first",
            episode=episode,
            design=torch.ones(1, 4),
            training_return=torch.zeros(1),
            evaluation_return=torch.zeros(1),
            env_steps=1000,
            imagined=0,
            metrics={"individual/entropy": torch.ones(1)},
            seconds=booked,
        )
        results.write(event, 3.0)
    with (tmp_path / "run" / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["seconds/train individual"] for row in rows] == ["1", "1"]
    assert [row["seconds/train population"] for row in rows] == ["2", "2"]
