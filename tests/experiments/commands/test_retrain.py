"""Fig. 2's retraining: which designs, that it is plain SAC from scratch, and that it goes on."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tiny_runs import tiny

from coim.experiments.commands.retrain import episodes_in_words, main
from coim.experiments.frames import read_frame
from coim.experiments.run.command_line import parse
from coim.experiments.run.settings import Settings, plain
from coim.experiments.study.retraining import Retrain, best_designs, cells_of, choose
from coim.experiments.study.runs import CHOSEN, read_runs
from tests.experiments.made_up_study import write_cell

PLACE = ("hopper", "forward")


KINDS = ("first", "optimised", "random", "optimised", "optimised")
RULE = {"top": 0.5, "most": 18, "of": "optimised"}


def found(study: Path, cell: str, *runs: tuple[float, float, float]) -> None:
    """A cell with three designs in each run that Eq. 5 chose, between better ones that it did not."""
    returns = ([90, one, 80, other, third] for one, other, third in runs)
    write_cell(study, cell, *returns, kinds=KINDS, num_designs=5)


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """Three runs of "known" and two, of one cell, of "none"."""
    found(tmp_path, "hopper-forward-known-0", (31, 27, 33))
    found(tmp_path, "hopper-forward-known-1", (5, 7, 6))
    found(tmp_path, "hopper-forward-known-2", (20, 28, 10))
    found(tmp_path, "hopper-forward-none-0", (1, 2, 3), (6, 5, 4))
    return tmp_path


def test_the_best_half_is_of_the_designs_that_eq_5_chose_in_each_run(study: Path) -> None:
    runs = read_runs(study)
    lines = best_designs(runs, PLACE, "known", RULE)
    # Half of three, rounded up, of each run: not the best five of all together, of which 6 and 7 would not be.
    assert lines["found_return"].tolist() == [33, 31, 28, 20, 7, 6]
    assert lines["folder"][0] == "hopper-forward-known-0-run0-design5"
    assert lines["xi"][0] == "1.5 1"
    assert lines[["found", "kept", "top", "most"]].drop_duplicates().to_numpy().tolist() == [[9, 6, 0.5, 18]]
    of_none = best_designs(runs, PLACE, "none", RULE)
    assert of_none[["run", "found_return"]].to_numpy().tolist() == [[1, 6], [1, 5], [0, 3], [0, 2]]
    assert len(best_designs(runs, PLACE, "none", RULE | {"top": 1.0})) == 6


def test_the_cap_is_divided_among_the_runs_alike_in_all_arms_and_at_least_one_each(study: Path) -> None:
    runs = read_runs(study)
    for most, of_none, of_known in ((3, 2, 3), (5, 4, 5), (6, 4, 6), (2, 2, 3)):  # of two runs and of three
        rule = RULE | {"top": 1.0, "most": most}
        assert len(best_designs(runs, PLACE, "none", rule)) == of_none
        assert len(best_designs(runs, PLACE, "known", rule)) == of_known


def test_the_best_body_of_each_run_may_be_of_any_kind(study: Path) -> None:
    write_cell(study, "hopper-forward-random-bodies-0", (3, 9, 5), kinds=("first", "random", "random"), num_designs=3)
    runs, path = read_runs(study), study / "chosen.csv"
    with pytest.raises(ValueError, match=r"no run of random-bodies has an optimised design yet; .* --of all"):
        choose(runs, path, Retrain(study=study, arms=("random-bodies",)))
    both = choose(runs, path, Retrain(study=study, arms=("none", "random-bodies"), of="all", most=1))
    assert both[["arm", "run", "design", "found_return"]].to_numpy().tolist() == [
        ["none", 0, 1, 90],
        ["none", 1, 1, 90],
        ["random-bodies", 0, 2, 9],
    ]
    assert both[["found", "of"]].drop_duplicates().to_numpy().tolist() == [[10, "all"], [3, "all"]]
    with pytest.raises(ValueError, match=r"--of is optimised, but the designs in .* were chosen by all"):
        choose(runs, path, Retrain(study=study, of="optimised"))


def test_a_share_of_whole_designs_is_not_rounded_up(tmp_path: Path) -> None:
    count = 25
    write_cell(
        tmp_path, "hopper-forward-known-0", range(count), kinds=["optimised"] * count, predicted=range(count),
        num_designs=count,
    )  # fmt: skip
    assert 7 / 25 * 25 > 7  # rounded up, it would be eight
    assert len(best_designs(read_runs(tmp_path), PLACE, "known", RULE | {"top": 7 / 25})) == 7


def test_what_was_chosen_is_not_chosen_again_and_other_arms_come_beside_it(study: Path) -> None:
    path = study / "chosen.csv"
    first = choose(read_runs(study), path, Retrain(study=study, arms=("known",)))
    found(study, "hopper-forward-known-7", (99, 98, 97))
    both = choose(read_runs(study), path, Retrain(study=study))
    assert both[:6].to_dict("records") == first.to_dict("records")
    assert both["arm"][6:].tolist() == ["none"] * 4
    assert read_frame(path, CHOSEN).to_dict("records") == both.to_dict("records")


def test_a_list_of_an_older_study_keeps_its_columns(study: Path) -> None:
    path = study / "chosen.csv"
    choose(read_runs(study), path, Retrain(study=study))
    head, *lines = path.read_text().splitlines()
    assert head.endswith("found_return,over,planned,found,kept,top,most,of")
    older = "".join(",".join(line.split(",")[:10]) + "\n" for line in [head, *lines])
    path.write_text(older)
    choose(read_runs(study), path, Retrain(study=study))
    assert path.read_text() == older


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
    assert lines[["arm", "found", "kept"]].to_numpy().tolist() == [*[["known", 9, 3]] * 3, *[["none", 6, 2]] * 2]
    assert lines[["top", "most"]].drop_duplicates().to_numpy().tolist() == [[0.7, 3]]


def settings_of(study: Path, cell: str, **values: object) -> Settings:
    """Give a made-up cell every setting of a run."""
    settings = parse("test", "", tiny("--imagine", "random", "--individual-imagined-share", "0.5", "--lr", "0.001"))
    config = {"environment": "hopper", "settings": plain(settings) | values}
    (study / "cells" / cell / "config.json").write_text(json.dumps(config))
    return settings


def test_a_retraining_has_the_settings_of_its_cell_but_for_what_is_not_sac_on_one_body(study: Path) -> None:
    cell = "hopper-forward-known-0"
    settings = settings_of(study, cell, dream="simulator", bodies="random", num_runs=3)
    lines = best_designs(read_runs(study), PLACE, "known", RULE)[1:3].to_dict("records")
    own = cells_of(lines[:1], Retrain(study=study, episodes=9))[0].settings
    assert (own.imagine, own.dream, own.population_updates, own.model_updates) == ("none", "ensemble", 0, 0)
    assert (own.individual_imagined_share, own.num_designs, own.num_runs) == (0, 1, 1)
    assert (own.first_design, own.first_episodes) == ((0.75, 1), 9)
    assert (own.lr, own.batch_size, own.individual_updates) == (0.001, settings.batch_size, settings.individual_updates)
    settings_of(study, "hopper-forward-known-2")
    other = cells_of(lines[1:], Retrain(study=study))[0].settings
    assert own.seed != other.seed
    assert other.first_episodes == settings.first_episodes


def test_it_is_told_how_many_episodes_each_design_will_have(study: Path) -> None:
    for seed in (2, 0):
        settings_of(study, f"hopper-forward-known-{seed}", first_episodes=300 + seed)
    lines = best_designs(read_runs(study), PLACE, "known", RULE)[1:3].to_dict("records")
    assert episodes_in_words(cells_of(lines, Retrain(study=study))) == "300 or 302"
    assert episodes_in_words(cells_of(lines, Retrain(study=study, episodes=9))) == "9"


def test_designs_of_an_arm_are_trained_together_each_with_a_body_of_its_own(study: Path) -> None:
    for seed in range(3):
        settings_of(study, f"hopper-forward-known-{seed}")
    asked = Retrain(study=study, arms=("known",), most=3, together=2)
    chosen = choose(read_runs(study), study / "chosen.csv", asked)
    runs = ("fleet0/0", "fleet0/1", "fleet1/0")
    assert chosen["trained"].tolist() == [f"hopper-forward-known-{run}" for run in runs]
    two, one = cells_of(chosen.to_dict("records"), asked)
    bodies = [float(factor) for xi in chosen["xi"] for factor in xi.split()]
    assert (two.name, two.settings.num_runs) == ("hopper-forward-known-fleet0", 2)
    assert [*two.settings.first_design, *one.settings.first_design] == bodies


def test_bodies_found_with_other_settings_are_not_trained_together_and_nothing_is_written(study: Path) -> None:
    asked = Retrain(study=study, arms=("known",), most=3, together=2)
    for seed in range(3):
        settings_of(study, f"hopper-forward-known-{seed}", lr=0.002 if seed == 2 else 0.001)
    with pytest.raises(ValueError, match=r"fleet0 cannot be trained together: .* differ in lr; leave --together out"):
        choose(read_runs(study), study / "chosen.csv", asked)
    assert not (study / "chosen.csv").exists()


@pytest.mark.parametrize(
    "other",
    [{"threads": 2}, {"compile": False}, {"checkpoint_every": 7}, {"num_iterations": 9, "search": "swarm"}],
    ids=lambda other: next(iter(other)),
)
def test_where_a_cell_was_computed_does_not_keep_its_body_from_a_fleet(study: Path, other: dict) -> None:
    for seed in range(3):
        settings_of(study, f"hopper-forward-known-{seed}", **other if seed == 2 else {})
    chosen = choose(read_runs(study), study / "chosen.csv", Retrain(study=study, arms=("known",), most=3, together=3))
    assert len(chosen) == 3


def test_bodies_that_their_studies_gave_other_numbers_of_episodes_may_share_a_number_that_is_given(study: Path) -> None:
    for seed in range(3):
        settings_of(study, f"hopper-forward-known-{seed}", first_episodes=300 + seed)
    asked = Retrain(study=study, arms=("known",), most=3, together=3, episodes=9)
    (fleet,) = cells_of(choose(read_runs(study), study / "chosen.csv", asked).to_dict("records"), asked)
    assert fleet.settings.first_episodes == 9


def test_what_cannot_be_asked_for_is_refused_in_a_sentence(study: Path, tmp_path: Path) -> None:
    for options, words in (
        (["--top", "0"], "--top is 0"),
        (["--most", "0"], "--most is 0"),
        (["--episodes", "0"], "--episodes is 0"),
        (["--together", "0"], "--together is 0"),
        (["--workers", "2", "--ray-address", "auto"], "a cluster decides itself"),
        (["--arms", "oracle"], "'oracle' is no arm of .*--arms none known"),
    ):
        with pytest.raises(SystemExit, match=words):
            main([str(study), *options])
    with pytest.raises(SystemExit, match="has no cells/"):
        main([str(tmp_path / "nowhere")])
    assert not (tmp_path / "nowhere").exists()


def test_an_arm_that_chose_no_body_has_nothing_to_retrain(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_cell(tmp_path, "hopper-forward-none-0", [90, 20])
    with pytest.raises(SystemExit, match="no run of none has an optimised design yet"):
        main([str(tmp_path), "--arms", "none"])
    found(tmp_path, "hopper-forward-known-0", (31, 27, 33))
    choose(read_runs(tmp_path), tmp_path / "chosen.csv", Retrain(study=tmp_path))
    assert capsys.readouterr().out == (
        "hopper, forward: no run of none has an optimised design, there is nothing to retrain of it\n"
    )
