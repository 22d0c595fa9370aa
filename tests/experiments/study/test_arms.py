"""An arm is one entry: everything that a study, its statistics and its figures need is read from there."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from coim.experiments.figures.write import write_figures
from coim.experiments.study.arms import ARMS, Arm, by_name, in_order
from coim.experiments.study.definition import Study
from tests.experiments.made_up_study import read_table, write_cell

MADE_UP = Arm(
    name="made-up",
    words="imagines the designs tried so far, twice",
    settings={"imagine": "known", "mix": "sum"},
    baselines=("none", "known"),
    family="imagination",
    colour="#123456",
    marker="X",
)


@pytest.mark.usefixtures("undrawn")
def test_one_entry_is_enough_for_study_statistics_and_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ARMS, "made-up", MADE_UP)
    study = Study(
        name="mine", environments=("hopper",), arms=("none", "known", "made-up"), seeds=(0,), protocol="smoke"
    )
    mixes = {cell.arm: cell.settings.mix for cell in study.cells()}
    assert (mixes["known"], mixes["made-up"]) == ("batch", "sum")
    for arm in ("none", "known", "made-up"):
        for seed in (0, 1):
            write_cell(tmp_path, f"hopper-forward-{arm}-{seed}", [10, 20, 30 + seed, 5])
    plots = {plot.name: plot for plot in write_figures(tmp_path)}
    folder = tmp_path / "figures"
    assert [row["arm"] for row in read_table(folder / "statistics_arms.csv")] == ["none", "known", "made-up"]
    pairs = {(row["arm"], row["against"]) for row in read_table(folder / "statistics_pairs.csv")}
    assert pairs == {("known", "none"), ("made-up", "none"), ("made-up", "known")}
    figure = plots["best_returns_imagination"].figure
    assert figure is not None
    (legend,) = figure.legends
    entry = {text.get_text(): line for text, line in zip(legend.get_texts(), legend.get_lines())}["made-up"]
    assert entry.get_color() == MADE_UP.colour
    assert MADE_UP.words in (folder / "README.md").read_text()


def test_an_arm_without_a_style_and_an_arm_that_nobody_knows_are_errors(tmp_path: Path) -> None:
    fields = {field.name: getattr(MADE_UP, field.name) for field in dataclasses.fields(MADE_UP)}
    for name in ("colour", "marker", "words", "baselines"):
        with pytest.raises(TypeError, match=name):
            Arm(**{key: value for key, value in fields.items() if key != name})
    write_cell(tmp_path, "hopper-forward-made-up-0", [10, 20, 30, 40])
    with pytest.raises(ValueError, match=r"arm 'made-up' is none of none, known, .*; add it to ARMS in coim\.exp"):
        write_figures(tmp_path)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"colour": "bluish"}, "colour of arm made-up is 'bluish'"),
        ({"marker": ""}, "marker of arm made-up is ''"),
        ({"name": "Made_Up"}, "'Made_Up' must be named by lower-case words"),
        ({"baselines": ("nobody",)}, "baselines of arm made-up are no other arms: nobody"),
        ({"colour": ARMS["known"].colour}, "known and made-up look alike"),
        (
            {"colour": ARMS["none"].colour, "family": "bodies", "baselines": ("none",)},
            "none and made-up look alike",
        ),  # its baseline
        ({"colour": ARMS["random-bodies"].colour, "marker": "P"}, "made-up look alike"),
        ({"name": "known"}, "two have the same name"),
    ],
)
def test_what_cannot_be_drawn_or_told_apart_is_refused(changes: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        by_name(*ARMS.values(), dataclasses.replace(MADE_UP, **changes))


def test_arms_of_a_family_and_their_baselines_have_lines_of_their_own() -> None:
    for family in {arm.family for arm in ARMS.values()}:
        own = [arm for arm in ARMS.values() if arm.family == family]
        names = in_order([*(arm.name for arm in own), *(name for arm in own for name in arm.baselines)])
        assert len({str(ARMS[name].line["linestyle"]) for name in names}) == len(names)  # also without colours
