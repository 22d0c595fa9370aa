"""A run's CSV files, row by row."""

from __future__ import annotations

import csv
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from coim import DesignChosen, DesignDone, EpisodeDone, HopperMorph, WalkerMorph
from coim.experiments.run.results import Results, Table, folder_of, new_folder
from coim.experiments.run.settings import Settings


def test_seconds_stand_under_their_part_whichever_learner_ends_first(tmp_path: Path) -> None:
    results = Results(tmp_path / "run", "hopper", Settings(), design_names=HopperMorph.design_names())
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


def test_the_table_on_the_terminal_has_the_names_of_the_body_above_its_numbers(tmp_path: Path) -> None:
    results = Results(tmp_path / "run", "walker", Settings(), design_names=WalkerMorph.design_names())
    design = torch.tensor([[1.0, 1.5, 1.0, 1.0, 1.0, 0.75, 1.0]])
    results.write(DesignChosen(0, "first", design, None), 1.0)
    results.write(DesignDone(0, "first", design, torch.tensor([123.456])), 2.0)
    head, row = results.table().splitlines()
    for name, value in (("torso", "1"), ("right thigh", "1.5"), ("left knee", "0.75"), ("best_return", "123.5")):
        end = head.index(name) + len(name)
        assert row[:end].split()[-1] == value


def test_a_file_whose_design_columns_are_counted_grows_on_under_its_own_header(tmp_path: Path) -> None:
    path = tmp_path / "designs.csv"
    path.write_text("run,xi_1,xi_2,best_return\n0,1,1,5\n0,2,2,6\n")
    Table(path, ["run", "xi_torso", "xi_foot", "best_return"], keep=1).append(
        [{"run": 0, "xi_torso": 3.0, "xi_foot": 3.0, "best_return": 7.0}]
    )
    assert path.read_text() == "run,xi_1,xi_2,best_return\n0,1,1,5\n0,3,3,7\n"
    for others in (
        ["run", "xi_torso", "xi_thigh", "xi_foot", "best_return"],
        ["run", "xi_torso", "foot", "best_return"],
    ):
        with pytest.raises(ValueError, match="has other columns"):
            Table(path, others, keep=1)


def test_runs_that_start_in_the_same_second_have_a_folder_each(tmp_path: Path) -> None:
    wanted = tmp_path / "runs" / "hopper-run"
    with ThreadPoolExecutor(8) as pool:
        made = sorted(path.name for path in pool.map(new_folder, [wanted] * 8))
    assert made == ["hopper-run", *(f"hopper-run-{i}" for i in range(2, 9))]
    assert sorted(path.name for path in wanted.parent.iterdir()) == made


def test_a_run_that_cannot_be_put_together_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with folder_of("hopper", Settings()) as folder:
        assert [*Path("runs").iterdir()] == [folder]
    folder.rmdir()
    with pytest.raises(ZeroDivisionError), folder_of("hopper", Settings()):
        _ = 1 / 0
    assert not list(Path("runs").iterdir())
    with folder_of("hopper", Settings(out=Path("named"))) as named:
        assert named == Path("named")
    assert not named.exists()


def test_a_place_for_runs_that_is_none_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "runs").touch()
    with pytest.raises(OSError, match=r"run cannot be written to \(.*name another folder for a new run with --out"):
        new_folder(tmp_path / "runs" / "run")
