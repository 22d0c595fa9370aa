"""A recipe as a user meets it: what it writes, what it refuses, and that it repeats."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from typing import get_args

import pytest
from tiny_runs import resume, run_by_options

from coim import HopperMorph
from coim.events import Kind
from coim.experiments.drawing.palette import KINDS
from coim.experiments.report.run_report import write_report
from coim.experiments.run.build import episodes_of_designs, first_designs, make_buffers
from coim.experiments.run.command_line import parse
from coim.experiments.run.settings import PRESETS, Settings

XI = ["xi_torso", "xi_thigh", "xi_shank", "xi_foot"]


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_run_leaves_its_settings_its_numbers_and_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    run_by_options(tmp_path / "run", page=True)
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    evaluations, designs = read(tmp_path / "run" / "evaluations.csv"), read(tmp_path / "run" / "designs.csv")
    assert config["environment"] == "hopper"
    assert config["settings"]["num_designs"] == 7
    assert config["versions"].keys() >= {"coim", "torch", "torchrl", "mujoco", "python"}
    assert [row["kind"] for row in designs] == ["first"] * 5 + ["optimised", "random"]
    assert [int(row["design"]) for row in evaluations] == list(range(1, 8))
    assert [name for name in evaluations[0] if name.startswith("xi_")] == XI
    for row, design in zip(evaluations, designs, strict=True):
        assert [row[name] for name in XI] == [design[name] for name in XI]
        assert row["return"] == design["best_return"]  # one evaluation each
    assert int(evaluations[-1]["env_steps"]) == 7 * 6
    assert (tmp_path / "run" / "figures" / "designs.png").stat().st_size > 10_000
    shown = capsys.readouterr().out
    assert "design 7/7 random  episode 1" in shown
    assert shown.count("\n") >= 7 + 8


def test_what_was_measured_while_learning_has_a_row_for_each_run_and_episode(tmp_path: Path) -> None:
    run_by_options(tmp_path / "fleet", "--num-runs", "2", "--num-designs", "2", "--first-episodes", "2", "--quiet")
    rows = read(tmp_path / "fleet" / "metrics.csv")
    assert [(row["run"], row["design"], row["episode"]) for row in rows] == [
        (run, design, episode) for design in "12" for episode in "12" for run in "01"
    ]
    losses = {f"{who}/{what}" for who in ("individual", "population") for what in ("loss_actor", "loss_qvalue")}
    parts = {"collect", "imagine", "train individual", "train population", "train model", "evaluate", "episode"}
    measured = {"impossible", "model_error", "model/loss_dynamics", "individual/entropy", "population/entropy"} | losses
    assert rows[0].keys() == {"run", "design", "episode", "broken", "diverged"} | measured | {
        f"seconds/{part}" for part in parts
    }
    assert {row.pop("diverged") for row in rows} == {""}
    assert all(float(value) == float(value) for row in rows for value in row.values())  # numbers, none of them NaN
    evaluations = read(tmp_path / "fleet" / "evaluations.csv")
    assert [row["model_error"] for row in rows] == [row["model_error"] for row in evaluations]


def test_the_same_seed_repeats_and_another_does_not(tmp_path: Path) -> None:
    for name, seed in (("a", "0"), ("b", "0"), ("c", "1")):
        run_by_options(tmp_path / name, "--seed", seed, "--quiet")
    a, b, c = ([row["return"] for row in read(tmp_path / name / "evaluations.csv")] for name in "abc")
    assert a == b
    assert a != c


def test_the_baseline_differs_from_the_method_by_imagination_alone(tmp_path: Path) -> None:
    for designs in ("known", "none"):
        run_by_options(tmp_path / designs, "--imagine", designs, "--quiet")
    ours, theirs = (read(tmp_path / designs / "evaluations.csv") for designs in ("known", "none"))
    # Until the population has learnt for the first time, nothing that was imagined reaches anything.
    assert ours[0]["training_return"] == theirs[0]["training_return"]
    assert ours[0]["return"] == theirs[0]["return"]
    assert ours[1]["return"] != theirs[1]["return"]
    for ours_too, theirs_too in zip(ours, theirs, strict=True):
        if ours_too["kind"] != "optimised":
            assert [ours_too[name] for name in XI] == [theirs_too[name] for name in XI]


def test_runs_in_lock_step_have_a_row_each(tmp_path: Path) -> None:
    run_by_options(tmp_path / "fleet", "--num-runs", "3", "--imagine", "noisy", "--task", "backward", "--quiet")
    designs = read(tmp_path / "fleet" / "designs.csv")
    assert [row["run"] for row in designs] == ["0", "1", "2"] * 7
    assert len({row["xi_torso"] for row in designs if row["kind"] == "random"}) == 3


def test_the_baseline_imagines_nothing_and_quiet_is_quiet(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    run_by_options(tmp_path / "run", "--imagine", "none", "--quiet")
    assert {row["model_error"] for row in read(tmp_path / "run" / "evaluations.csv")} == {""}
    assert capsys.readouterr().out == ""


def test_offline_wandb_needs_no_account(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run_by_options(tmp_path / "run", "--wandb", "offline", "--num-designs", "1", "--quiet")
    assert list((tmp_path / "run").glob("wandb/offline-run-*/*.wandb"))
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--imagined-share", "1.5"], "share is 1.5, it must be at most 1"),
        (["--device", "cuda:99"], "device 'cuda:99' cannot be used here"),
        (["--device", "abacus"], "device 'abacus' cannot be used here"),
        (["--num-runs", "0"], "--num-runs is 0, it must be at least 1"),
        (["--first-episodes", "0"], "--first-episodes is 0, it must be at least 1"),
        (["--threads", "-1"], "--threads is -1, it must be at least 0"),
        (["--sigma", "-1", "--imagine", "noisy"], "sigma is -1"),
        (["--sigma", "nan", "--imagine", "noisy"], "sigma is nan"),
        (["--mix", "stirred"], "stirred"),
        (["--no-such-option"], "no-such-option"),
        (["--preset", "slow"], "slow"),
    ],
)
def test_bad_options_get_a_sentence_and_leave_no_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture, options: list[str], sentence: str
) -> None:
    with pytest.raises(SystemExit) as stop:
        run_by_options(tmp_path / "run", *options)
    assert stop.value.code not in (0, None)
    assert sentence in f"{stop.value.code} {capsys.readouterr().err}"
    assert not (tmp_path / "run").exists()


def test_a_folder_that_holds_something_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "evaluations.csv").write_text("precious")
    with pytest.raises(SystemExit) as stop:
        run_by_options(tmp_path)
    assert "already holds something" in str(stop.value.code)
    assert [path.name for path in tmp_path.iterdir()] == ["evaluations.csv"]
    assert (tmp_path / "evaluations.csv").read_text() == "precious"


def test_a_preset_moves_defaults_and_options_win_over_it() -> None:
    quick = parse("prog", "", ["--preset", "quick"])
    assert quick == PRESETS["quick"]
    assert parse("prog", "", ["--preset", "quick", "--episodes", "9"]).episodes == 9
    assert parse("prog", "", []) == PRESETS["paper"]


def test_every_setting_has_a_sentence_of_help(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit):
        parse("prog", "", ["--help"])
    shown = capsys.readouterr().out
    for name in Settings.__dataclass_fields__:
        assert "--" + name.replace("_", "-") in shown, name
    assert "Temperature" in shown or "temperature" in shown


def test_the_papers_numbers_are_the_defaults() -> None:
    paper = Settings()
    assert (paper.num_designs, paper.first_episodes, paper.episodes, paper.episode_steps) == (55, 300, 100, 1000)
    assert (paper.individual_updates, paper.population_updates, paper.batch_size) == (1000, 250, 256)
    assert (paper.gamma, paper.tau, paper.lr, paper.alpha, paper.num_cells) == (0.99, 0.005, 3e-4, 0.01, (200,) * 3)
    assert (paper.num_members, paper.model_cells, paper.model_lr, paper.weight_decay) == (3, (500,) * 3, 3e-4, 1e-5)
    assert (paper.num_start_states, paper.imagined_share, paper.sigma) == (36, 0.2, 0.1)


def test_the_simulator_imagines_and_no_model_is_learnt(tmp_path: Path) -> None:
    run_by_options(tmp_path / "oracle", "--imagine", "random", "--dream", "simulator", "--num-designs", "2", "--quiet")
    run_by_options(tmp_path / "none", "--imagine", "none", "--num-designs", "2", "--quiet")
    ours, theirs = (read(tmp_path / name / "evaluations.csv") for name in ("oracle", "none"))
    assert [row["model_error"] for row in ours] == [""] * 2
    assert "model/loss_dynamics" not in read(tmp_path / "oracle" / "metrics.csv")[0]
    # Paired: until the population has learnt from what was imagined, the runs are the same.
    assert ours[0]["return"] == theirs[0]["return"]
    assert ours[1]["return"] != theirs[1]["return"]


def test_impossible_pairs_are_counted_in_the_tables_and_matched_states_have_none(tmp_path: Path) -> None:
    shares = {}
    for states in ("stored", "matched"):
        how = ("--imagine", "random", "--imagined-states", states, "--value-states", states)
        run_by_options(tmp_path / states, *how, "--num-designs", "4", "--quiet")
        shares[states] = [float(row["impossible"]) for row in read(tmp_path / states / "metrics.csv")]
    assert shares["matched"] == [0] * 4
    assert max(shares["stored"]) > 0


def test_a_governed_run_whose_model_has_learnt_too_little_is_the_baseline(tmp_path: Path) -> None:
    how = ("--imagine", "random", "--imagined-states", "matched", "--anchored", "--governed")
    run_by_options(tmp_path / "governed", *how, "--num-designs", "3", "--quiet")
    run_by_options(tmp_path / "none", "--imagine", "none", "--num-designs", "3", "--quiet")
    ours, theirs = (read(tmp_path / name / "evaluations.csv") for name in ("governed", "none"))
    assert [row["return"] for row in ours] == [row["return"] for row in theirs]
    assert [float(row["imagined_share"]) for row in read(tmp_path / "governed" / "metrics.csv")] == [0, 0, 0]


def test_a_fixed_body_is_marked_as_such(tmp_path: Path) -> None:
    run_by_options(tmp_path / "fixed", "--imagine", "none", "--bodies", "fixed", "--quiet", page=True)
    designs = read(tmp_path / "fixed" / "designs.csv")
    assert [row["kind"] for row in designs] == ["fixed"] * 7
    assert all(float(row[name]) == 1 for row in designs for name in XI)
    assert len({KINDS[kind] for kind in get_args(Kind)}) == len(KINDS)  # pictures tell every kind apart


def test_a_simulator_without_designs_to_imagine_is_refused(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit):
        parse("hopper", "", ["--dream", "simulator", "--imagine", "none"])
    assert "imagines nothing with" in capsys.readouterr().err


def test_a_body_may_have_more_first_designs_than_the_papers(tmp_path: Path) -> None:
    class Hopper(HopperMorph):
        FIRST_DESIGNS = (*HopperMorph.FIRST_DESIGNS, *HopperMorph.FIRST_DESIGNS[1:3])

    settings = Settings(num_designs=9, first_episodes=3, episodes=2, episode_steps=6)
    assert episodes_of_designs(Hopper, settings) == 7 * [3] + 2 * [2]
    buffers = make_buffers(Hopper(), settings, seed=0)
    assert (buffers.pop.capacity, buffers.s0.capacity) == (25 * 6, 25)


def test_a_run_can_begin_with_one_body_of_its_own(tmp_path: Path) -> None:
    run_by_options(
        tmp_path, "--first-design", "0.8", "1.2", "1", "1.5", "--num-designs", "2", "--first-episodes", "2", "--quiet"
    )
    rows = read(tmp_path / "evaluations.csv")
    assert [row["kind"] for row in rows] == ["first", "first", "optimised"]
    assert [float(rows[0][name]) for name in XI] == [0.8, 1.2, 1, 1.5]


@pytest.mark.parametrize(
    ("num_runs", "words"), [(1, "has 8 .*; give 4$"), (3, "has 8 .*; give 4, or 12 for a design of each of 3 runs")]
)
def test_a_first_body_has_all_factors_for_one_run_or_for_each(num_runs: int, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        first_designs(HopperMorph, Settings(first_design=(1.0,) * 8, num_runs=num_runs))


@pytest.mark.parametrize("chosen_by", ["returns", "posterior"])
def test_a_run_whose_bodies_are_chosen_by_returns_writes_what_it_expects_and_goes_on_alike(
    chosen_by: str, tmp_path: Path
) -> None:
    words = ["--imagine", "none", "--search", "gradient", "--chosen-by", chosen_by, "--value-over", "visited"]
    run_by_options(tmp_path / "whole", *words)
    run_by_options(tmp_path / "part", *words, "--num-designs", "6")
    resume(tmp_path / "part", "--num-designs", "7")
    whole, part = (read(tmp_path / name / "designs.csv") for name in ("whole", "part"))
    assert whole == part
    known = [row["expected"] != "" and row["deviation"] != "" for row in whole]
    assert known == [False] * 3 + [True] * 4  # from three returns on
    assert all(float(row["deviation"]) > 0 for row in whole[3:])
    assert write_report([tmp_path / "whole"]).exists()


def test_a_run_by_eq_5_has_no_columns_of_what_is_expected(tmp_path: Path) -> None:
    run_by_options(tmp_path / "run")
    assert not {"expected", "deviation"} & read(tmp_path / "run" / "designs.csv")[0].keys()


def test_returns_without_botorch_are_refused_in_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "coim.posterior_choice", raising=False)
    monkeypatch.delitem(sys.modules, "coim.designs.posterior", raising=False)
    monkeypatch.setitem(sys.modules, "botorch", None)
    monkeypatch.setitem(sys.modules, "botorch.settings", None)
    with pytest.raises(SystemExit, match=r"pip install 'coim\[posterior\]', or choose bodies by value"):
        run_by_options(tmp_path / "run", "--chosen-by", "returns")
