"""What a run says at its end: its best body by names, and commands that work as they stand."""

from __future__ import annotations

import dataclasses
import shlex
from pathlib import Path

import pytest
import tyro
from tiny_runs import TINY, run, without_page

from coim import HopperMorph, load_run
from coim.experiments.commands.watch import Watch
from coim.experiments.drawing.film import choose
from coim.experiments.run.build import first_designs
from coim.experiments.run.command_line import parse
from coim.experiments.run.last_words import best_of, last_words, options, plain_sac
from coim.experiments.run.resume import saved_settings
from coim.experiments.run.settings import PRESETS, Settings
from coim.experiments.train import main


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(tmp_path_factory.mktemp("a fleet") / "run", num_runs=2)


def words(line: str, command: str) -> list[str]:
    """The words after a command in a line ``...: COMMAND ...``."""
    assert f": {command} " in line
    return shlex.split(line.split(f": {command} ", 1)[1])


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"preset": "quick"},
        {"compile": False, "num_cells": (8, 8), "lr": 1e-5, "task": "backward", "out": Path("my runs/a")},
        {"preset": "quick", "compile": True, "first_design": (0.8, 1.3333334, 1.0, 2.0), "seed": 7, "quiet": True},
    ],
)
def test_options_give_the_settings_again(changed: dict) -> None:
    settings = dataclasses.replace(PRESETS[str(changed.get("preset", "paper"))], **changed)
    assert parse("recipe", "", shlex.split(shlex.join(options(settings)))) == settings


def test_the_end_of_a_run_names_the_best_body_and_how_to_film_and_retrain_it(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = run(Path("my run"), quiet=False)
    best = max(load_run(folder).designs, key=lambda design: design.best_return)
    body, film, anew = capsys.readouterr().out.splitlines()[-3:]
    assert body.startswith(f"best body: design {best.number} (first), return {best.best_return:.4g}: torso ")
    for name, xi in zip(("torso", "thigh", "shank", "foot"), best.design.tolist()):
        assert f"{name} {xi:.4g}" in body

    asked = tyro.cli(Watch, args=words(film, "coim watch"))
    (chosen,) = choose(load_run(asked.folder), asked.design, asked.run)
    assert chosen.number == best.number

    with without_page():
        main(HopperMorph, "hopper", [*words(anew, "coim run hopper"), "--out", "alone", "--quiet"])
    (alone,) = load_run("alone").designs
    assert alone.design.tolist() == best.design.tolist()
    assert load_run("alone").ensemble is None
    assert "to film it" in last_words(Path("alone"), "hopper", HopperMorph, saved_settings(Path("alone")))[-1]


def test_the_best_of_a_fleet_is_one_of_one_run(fleet: Path) -> None:
    settings = dataclasses.replace(TINY, num_runs=2)
    best = best_of(fleet)
    assert best is not None
    body, film, _ = last_words(fleet, "hopper", HopperMorph, settings)
    assert f"design {best.number} of run {best.run} (" in body
    asked = tyro.cli(Watch, args=words(film, "coim watch"))
    assert (asked.design, asked.run) == (str(best.number), best.run)
    assert best.best_return == max(design.best_return for design in load_run(fleet).designs)


def test_a_body_without_a_recipe_is_named_and_nothing_is_promised(fleet: Path) -> None:
    class Nameless(HopperMorph):
        DESIGN_NAMES = ()

    (body,) = last_words(fleet, "hopper", Nameless, TINY)
    assert ": design 0 " in body


def test_without_a_return_there_is_no_best_body(tmp_path: Path) -> None:
    (tmp_path / "designs.csv").write_text("run,design,kind,xi_torso,predicted,best_return,diverged\n")
    assert last_words(tmp_path, "hopper", HopperMorph, TINY) == []


def test_plain_sac_trains_one_body_and_imagines_nothing() -> None:
    alone = plain_sac(Settings(imagine="noisy", num_runs=4), (1.0, 1.5, 1.0, 1.0), seed=9)
    assert first_designs(HopperMorph, alone) == [(1.0, 1.5, 1.0, 1.0)]
    assert (alone.imagine, alone.num_designs, alone.num_runs, alone.population_updates) == ("none", 1, 1, 0)
    assert (alone.seed, alone.individual_updates) == (9, Settings.individual_updates)
