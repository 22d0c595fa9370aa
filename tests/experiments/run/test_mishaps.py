"""What can go wrong in a run without ending it: it is said, in the files and on the page too, and the rest goes on."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch
from interrupted_runs import cut
from tiny_runs import resume
from tiny_runs import run as run_tiny

from benchmarks import soak
from coim import DynamicsLearner, HopperMorph, SACLearner, load_run
from coim.experiments.drawing.film import choose
from coim.experiments.report.run_report import write_report
from coim.experiments.report.summary_png import draw_run
from coim.experiments.run.records import read_record
from coim.run_folder import DESIGNS, EVALUATIONS, METRICS
from tests.experiments.report.report_page import check

FLEET = {"num_runs": 3, "imagine": "noisy"}


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def spoil(patched: pytest.MonkeyPatch, *, from_call: int, runs: Any = 1) -> None:
    """Let runs diverge from that call on: two of them, of the individual and of the population, are an episode's."""
    update, calls = SACLearner.update, 0

    def spoilt(learner: SACLearner, batches: Any) -> Any:
        nonlocal calls
        calls += 1
        losses = update(learner, batches)
        if calls >= from_call:
            for weights in learner.weights_by_run():
                weights[runs] = torch.nan
            losses["loss_actor"][runs] = torch.nan
        return losses

    patched.setattr(SACLearner, "update", spoilt)


def run(folder: Path, *, runs: Any = 1, **settings: Any) -> Path:
    """A tiny run that diverges on its second design, in the first of two episodes."""
    with pytest.MonkeyPatch.context() as patched:
        spoil(patched, from_call=5, runs=runs)
        return run_tiny(folder, **settings)


@pytest.fixture(scope="module")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_tiny(tmp_path_factory.mktemp("healthy") / "run", **FLEET)


@pytest.fixture(scope="module")
def ill(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(tmp_path_factory.mktemp("ill") / "run", **FLEET)


def test_a_diverged_run_has_no_rows_after_the_one_that_says_so_and_the_others_have_theirs(
    healthy: Path, ill: Path
) -> None:
    for layout, last in ((EVALUATIONS, 3), (METRICS, 3), (DESIGNS, 2)):
        expected, rows = (soak.rows_without_seconds(folder, layout) for folder in (healthy, ill))
        assert [row for row in rows if row["run"] != 1] == [row for row in expected if row["run"] != 1]
        own = [row for row in rows if row["run"] == 1]
        assert [row["diverged"] for row in own] == [""] * (last - 1) + ["design 2, episode 1"]
    evaluations = [row for row in read(ill / "evaluations.csv") if row["run"] == "1"]
    assert all(torch.tensor(float(row["return"])).isfinite() for row in evaluations)
    assert read(ill / "designs.csv")[4]["best_return"] == evaluations[-1]["return"]


def test_a_diverged_run_is_told_and_the_page_shows_it(
    healthy: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    folder = run(tmp_path / "run", **FLEET)
    shown = capsys.readouterr()
    assert shown.err.count("warning: run 1 diverged at design 2, episode 1") == 1
    assert "2 of 3 run(s) go on" in shown.err
    assert shown.out == ""
    page = check(write_report([folder]))
    assert "run 1 diverged at design 2, episode 1: its losses or weights" in page.words
    assert "diverged at" in page.words
    assert "all 4 designs are done" in page.words
    assert "diverged at" not in check(write_report([healthy])).words
    both = check(write_report([healthy, folder], out=tmp_path / "both.html"))
    assert both.words.count("diverged at") == 1
    assert "<td>0</td></tr>\n" in (tmp_path / "both.html").read_text()
    assert "<td>1</td></tr>\n" in (tmp_path / "both.html").read_text()


def test_what_is_left_of_a_diverged_design_is_not_a_finished_one(ill: Path) -> None:
    finished = read_record(ill, "").designs.set_index(["run", "design"])["finished"]
    assert not finished[1, 2]
    assert finished[0, 2]
    assert (1, 3) not in finished.index


def test_a_script_finds_where_a_run_diverged(ill: Path) -> None:
    found = {(design.run, design.number): design.diverged for design in load_run(ill).designs}
    assert {key for key, place in found.items() if place} == {(1, 2)}
    assert found[1, 2] == "design 2, episode 1"
    assert (1, 3) not in found


def test_a_design_that_a_diverged_run_never_had_is_not_offered_for_a_film(ill: Path) -> None:
    with pytest.raises(ValueError, match=r"numbers of the designs that are done of run 1, \[1, 2\]"):
        choose(load_run(ill), "3", 1)


def test_the_picture_has_the_bodies_of_the_best_run(ill: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Were it the first run's, one that diverged early would leave a picture of a body or two."""
    drawn: list[pd.DataFrame] = []
    monkeypatch.setattr("coim.experiments.report.summary_png.draw_bodies", lambda axes, rows, body: drawn.append(rows))
    record = read_record(ill, "")
    record.designs["best_return"] = 1.0 + record.designs["run"]
    monkeypatch.setattr("coim.experiments.report.summary_png.read_record", lambda *_: record)
    draw_run(ill, HopperMorph)
    assert drawn[0][["run", "design"]].to_numpy().tolist() == [[2, number] for number in (1, 2, 3, 4)]


def test_a_run_that_was_cut_after_it_diverged_goes_on_as_the_whole_one(ill: Path, tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patched:
        spoil(patched, from_call=5)
        folder = cut(tmp_path / "cut", 7, **FLEET)
        spoil(patched, from_call=1)
        resume(folder)
    assert soak.differences(ill, folder) == []


@pytest.mark.parametrize("num_runs", [1, 2])
def test_when_no_run_is_left_it_ends_by_itself_and_has_a_page(
    tmp_path: Path, capsys: pytest.CaptureFixture, num_runs: int
) -> None:
    folder = run(tmp_path / "run", runs=slice(None), num_runs=num_runs)
    shown = capsys.readouterr().err
    assert "0 of " in shown
    assert "every run has diverged" in shown
    assert len(read(folder / "evaluations.csv")) == 3 * num_runs
    assert [row["diverged"] for row in read(folder / "designs.csv")] == [""] * num_runs + [
        "design 2, episode 1"
    ] * num_runs
    assert "every run has diverged, the last at design 2, episode 1" in check(write_report([folder])).words
    before = [(folder / name).read_text() for name in ("evaluations.csv", "metrics.csv")]
    resume(folder, "--num-designs", "9")
    assert [(folder / name).read_text() for name in ("evaluations.csv", "metrics.csv")] == before


def test_an_ensemble_that_diverges_ends_its_run_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        DynamicsLearner, "update", lambda learner, batches: {"loss_dynamics": torch.tensor([torch.inf])}
    )
    folder = run_tiny(tmp_path / "run")
    assert [row["diverged"] for row in read(folder / "evaluations.csv")] == ["design 1, episode 1"]
    assert read(folder / "metrics.csv")[0]["model/loss_dynamics"] == "inf"


@pytest.mark.usefixtures("undrawn")
def test_a_simulation_that_breaks_is_told_and_the_run_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    move, steps = HopperMorph.move, 0

    def move_and_break(env: HopperMorph, action: torch.Tensor) -> Any:
        nonlocal steps
        steps += 1
        if steps == 15:  # the second training episode is the steps 13 to 18
            env.simulations.qvel[1] = 1e30
        return move(env, action)

    monkeypatch.setattr(HopperMorph, "move", move_and_break)
    folder = run_tiny(tmp_path / "run", **FLEET)
    shown = capsys.readouterr().err
    assert shown == (
        "warning: the simulation of run 1 broke 1 time(s) in design 1, episode 2; each time it started again from "
        "rest\n"
    )
    rows = read(folder / "metrics.csv")
    assert [row["broken"] for row in rows] == ["0"] * 4 + ["1"] + ["0"] * (len(rows) - 5)
    assert len(read(folder / "designs.csv")) == 4 * 3
    assert all(torch.tensor(float(row["return"])).isfinite() for row in read(folder / "evaluations.csv"))
    assert "1 simulation(s) broke" in check(write_report([folder])).words
