"""Fig. 2's retraining: which designs, that it is plain SAC from scratch, and that it goes on."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import pytest

from coim import HopperMorph
from recipes import experiment
from recipes.figures import write_figures
from recipes.plots.runs import read_runs
from recipes.retrain import Retrain, best_designs, cell_of, choose, episodes_in_words, main
from recipes.settings import Settings, parse, plain
from tests.recipes.made_up_study import KINDS, read_table, write_cell
from tests.recipes.test_experiment import TINY

PLACE = ("hopper", "forward")


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """One optimised design each, with best returns 33, 31, ... 25 of "known" and 5, 6 of "none"."""
    for seed, best in enumerate((31, 27, 33, 25, 29)):
        write_cell(tmp_path, f"hopper-forward-known-{seed}", [90, 20, best, 80])
    write_cell(tmp_path, "hopper-forward-none-0", [90, 20, 5, 80], [90, 20, 6, 80])
    return tmp_path


RULE = {"top": 0.5, "most": 18}


def test_the_best_half_is_of_the_designs_that_eq_5_chose_from_all_seeds_together(study: Path) -> None:
    assert KINDS[2] == "optimised"
    runs = read_runs(study)
    found = list(best_designs(runs, PLACE, ["known"], RULE))
    assert [line["found_return"] for line in found] == ["33", "31", "29"]  # half of five, rounded up
    assert found[0]["folder"] == "hopper-forward-known-2-run0-design3"
    assert found[0]["xi"] == "1 1"
    assert {(line["found"], line["kept"], line["top"], line["most"]) for line in found} == {("5", "3", "0.5", "18")}
    assert [line["run"] for line in best_designs(runs, PLACE, ["none"], RULE)] == ["1"]
    most = list(best_designs(runs, PLACE, ["known"], {"top": 1.0, "most": 2}))
    assert [line["found_return"] for line in most] == ["33", "31"]


def test_the_cap_takes_the_same_share_of_an_arm_with_more_designs_and_of_one_with_less(tmp_path: Path) -> None:
    for arm, count in (("none", 12), ("known", 6)):
        write_cell(tmp_path, f"hopper-forward-{arm}-0", *([90, 20, best, 80] for best in range(count)))
    runs = read_runs(tmp_path)
    rule = {"top": 0.5, "most": 4}
    together = list(best_designs(runs, PLACE, ["none", "known"], rule))
    assert [line["arm"] for line in together] == ["none"] * 4 + ["known"] * 2  # a third of each
    assert [line["found_return"] for line in together if line["arm"] == "known"] == ["5", "4"]
    later = list(best_designs(runs, PLACE, ["known"], rule, there=together[:1]))
    assert later == together[4:]
    thirds = list(best_designs(runs, PLACE, ["none"], {"top": 0.1, "most": 4}))
    assert len(thirds) == 2  # 1.2, rounded up


def test_the_cap_is_kept_to_the_last_bit(tmp_path: Path) -> None:
    write_cell(tmp_path, "hopper-forward-known-0", *([90, 20, best, 80] for best in range(25)))
    assert 7 / 25 * 25 > 7  # rounded up, it would be eight
    assert len(list(best_designs(read_runs(tmp_path), PLACE, ["known"], {"top": 0.5, "most": 7}))) == 7


def test_what_was_chosen_is_not_chosen_again_and_other_arms_come_beside_it(study: Path) -> None:
    path = study / "chosen.csv"
    first = choose(read_runs(study), path, Retrain(study=study, arms=("known",)))
    write_cell(study, "hopper-forward-known-7", [90, 20, 99, 80])
    both = choose(read_runs(study), path, Retrain(study=study))
    assert both[:3] == first
    assert [line["arm"] for line in both[3:]] == ["none"]
    assert read_table(path) == both


def test_another_rule_than_what_stands_there_was_chosen_by_is_refused(study: Path) -> None:
    path, runs = study / "chosen.csv", read_runs(study)
    choose(runs, path, Retrain(study=study, arms=("known",), top=0.7, most=3))
    before = path.read_bytes()
    for name, value, words in (
        (
            "top",
            0.5,
            "--top is 0.5, but the designs in .*retrained were chosen by 0.7; leave the option out, or delete",
        ),
        ("most", 4, "--most is 4, but the designs in .*retrained were chosen by 3; leave"),
    ):
        for arms in (("known",), ("none",)):
            with pytest.raises(ValueError, match=words):
                choose(runs, path, Retrain(study=study, arms=arms, **{name: value}))
    assert path.read_bytes() == before
    lines = choose(runs, path, Retrain(study=study, top=0.7))  # the same, and one that is left out
    assert [(line["arm"], line["found"], line["kept"]) for line in lines] == [
        *[("known", "5", "3")] * 3,
        *[("none", "2", "2")] * 2,  # 3/5 of two, rounded up
    ]
    assert {(line["top"], line["most"]) for line in lines} == {("0.7", "3")}


def settings_of(study: Path, cell: str, **values: object) -> Settings:
    """Give a made-up cell every setting of a run."""
    settings = parse("test", "", [*TINY, "--designs", "random", "--individual-imagined-share", "0.5", "--lr", "0.001"])
    config = {"environment": "hopper", "settings": plain(settings) | values}
    (study / "cells" / cell / "config.json").write_text(json.dumps(config))
    return settings


def test_a_retraining_has_the_settings_of_its_cell_but_for_what_is_not_sac_on_one_body(study: Path) -> None:
    cell = "hopper-forward-known-2"
    settings = settings_of(study, cell, dream="simulator", bodies="random", num_runs=3)
    lines = list(best_designs(read_runs(study), PLACE, ["known"], RULE))
    own = cell_of(lines[0], Retrain(study=study, episodes=9)).settings
    assert (own.designs, own.dream, own.population_updates, own.model_updates) == ("none", "ensemble", 0, 0)
    assert (own.individual_imagined_share, own.num_designs, own.num_runs) == (0, 1, 1)
    assert (own.first_design, own.first_episodes) == ((1, 1), 9)
    assert (own.lr, own.batch_size, own.individual_updates) == (0.001, settings.batch_size, settings.individual_updates)
    settings_of(study, "hopper-forward-known-0")
    other = cell_of(lines[1], Retrain(study=study)).settings
    assert own.seed != other.seed
    assert other.first_episodes == settings.first_episodes


@pytest.mark.usefixtures("cluster")
def test_designs_are_retrained_once_and_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("recipes.retrain.ray_running", lambda **_: contextlib.nullcontext())  # on the cluster there is
    for arm in ("none", "known"):
        folder = tmp_path / "cells" / f"hopper-forward-{arm}-0"
        experiment.main(HopperMorph, "hopper", [*TINY, "--designs", arm, "--quiet", "--out", str(folder)])
    with pytest.raises(SystemExit, match=r"no node has 1 cores and 0.5 of a GPU here; ask for less"):
        main([str(tmp_path), "--episodes", "2", "--gpus", "0.5"])
    capsys.readouterr()
    main([str(tmp_path), "--episodes", "2", "--workers", "1"])
    said = capsys.readouterr().out
    assert "2 of 2 designs to train" in said
    assert "\n2 training episodes on each\n" in said
    chosen = read_table(tmp_path / "retrained" / "designs.csv")
    for line in chosen:
        cell = tmp_path / "cells" / line["cell"]
        found = next(row for row in read_table(cell / "designs.csv") if row["kind"] == "optimised")
        episodes = read_table(tmp_path / "retrained" / "cells" / line["folder"] / "evaluations.csv")
        assert [row["kind"] for row in episodes] == ["first", "first"]
        assert [row["episode"] for row in episodes] == ["1", "2"]
        assert all(row[f"xi_{i}"] == found[f"xi_{i}"] for row in episodes for i in range(1, 5))
    main([str(tmp_path), "--episodes", "2", "--workers", "1"])
    assert "0 of 2 designs to train" in capsys.readouterr().out
    with pytest.raises(SystemExit, match=r"made with other settings: first_episodes \(2 to 3\)"):
        main([str(tmp_path), "--episodes", "3"])
    write_figures(tmp_path)
    rows = read_table(tmp_path / "figures" / "figure_2_retrained.csv")
    for row, line in zip(rows, chosen, strict=True):
        own = read_table(tmp_path / "retrained" / "cells" / line["folder"] / "evaluations.csv")
        assert float(row["best_return"]) == max(float(episode["return"]) for episode in own)
        assert (row["episodes"], row["study_episodes"]) == ("2", TINY[TINY.index("--episodes") + 1])


def test_it_is_told_how_many_episodes_each_design_will_have(study: Path) -> None:
    for seed in (2, 0):
        settings_of(study, f"hopper-forward-known-{seed}", first_episodes=300 + seed)
    lines = list(best_designs(read_runs(study), PLACE, ["known"], RULE))[:2]
    assert episodes_in_words([cell_of(line, Retrain(study=study)) for line in lines]) == "300 or 302"
    assert episodes_in_words([cell_of(line, Retrain(study=study, episodes=9)) for line in lines]) == "9"


def test_what_cannot_be_asked_for_is_refused_in_a_sentence(study: Path, tmp_path: Path) -> None:
    for options, words in (
        (["--top", "0"], "--top is 0"),
        (["--most", "0"], "--most is 0"),
        (["--episodes", "0"], "--episodes is 0"),
        (["--workers", "2", "--ray-address", "auto"], "a cluster decides itself"),
        (["--arms", "oracle"], "'oracle' is no arm of .*--arms none known"),
    ):
        with pytest.raises(SystemExit, match=words):
            main([str(study), *options])
    with pytest.raises(SystemExit, match="has no cells/"):
        main([str(tmp_path / "nowhere")])
    assert not (tmp_path / "nowhere").exists()


def test_an_arm_that_chose_no_body_has_nothing_to_retrain(tmp_path: Path) -> None:
    write_cell(tmp_path, "hopper-forward-none-0", [90, 20])
    with pytest.raises(SystemExit, match="no run of none has an optimised design yet"):
        main([str(tmp_path), "--arms", "none"])
