"""What a study consists of, and the ledger that remembers how far it has got."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import pytest
from interrupted_runs import cut
from tiny_runs import TINY, resume

from coim import EpisodeDone, HopperMorph
from coim.envs import BODIES
from coim.experiments.commands.study import main as entry
from coim.experiments.run.build import build
from coim.experiments.run.resume import LATER, still_finished, to_go_on
from coim.experiments.run.settings import METHODS, Settings, plain
from coim.experiments.study.arms import ARMS
from coim.experiments.study.cell import compute, episodes_done, seconds_of, tries
from coim.experiments.study.definition import PROTOCOLS, Block, Study, from_json
from coim.experiments.study.ledger import Ledger, State, read_ledger
from coim.experiments.study.named import STUDIES
from coim.experiments.study.ray_scheduler import Resources, all_episodes, take_up


def study(**fields: object) -> Study:
    least = {"name": "s", "environments": ("hopper",), "arms": ("none", "known"), "seeds": (3, 4), "protocol": "smoke"}
    return Study(**{**least, **fields})


def test_every_combination_is_a_cell_and_one_seed_of_all_arms_comes_before_the_next() -> None:
    more = Block(environments=("walker",), arms=("none",), seeds=(7, 8, 9), tasks=("backward",))
    assert [cell.name for cell in study(blocks=(more,)).cells()] == [
        "hopper-forward-none-3",
        "hopper-forward-known-3",
        "walker-backward-none-7",
        "hopper-forward-none-4",
        "hopper-forward-known-4",
        "walker-backward-none-8",
        "walker-backward-none-9",
    ]


def test_arms_of_a_seed_differ_in_nothing_but_the_arm() -> None:
    cells = study(arms=tuple(ARMS), seeds=(5,), overrides={"lr": 0.1}).cells()
    assert len(cells) == len(ARMS)
    common = {name: getattr(Settings(), name) for arm in ARMS.values() for name in arm.settings}
    assert len({dataclasses.replace(cell.settings, **common) for cell in cells}) == 1
    assert len({cell.settings for cell in cells}) == len(ARMS)
    assert {cell.settings.lr for cell in cells} == {0.1}
    assert {cell.settings.seed for cell in cells} == {5}


def test_arms_of_a_seed_compute_the_same_until_something_is_imagined_for_them() -> None:
    """On the first body no individual network has met the population's: whatever differs there is a stream that moved.

    The random bodies are the same later on too.
    """
    first, random = {}, {}
    for cell in study(arms=tuple(ARMS), seeds=(5,), overrides={"first_episodes": 2, "num_designs": 7}).cells():
        episodes = [event for event in build(BODIES["hopper"], cell.settings) if isinstance(event, EpisodeDone)]
        first[cell.arm] = [
            (float(e.training_return), float(e.evaluation_return), float(e.metrics["individual/loss_qvalue"]))
            for e in episodes
            if e.index == 0
        ]
        random[cell.arm] = [e.design.tolist() for e in episodes if e.kind == "random"][:1]
    assert len(first["none"]) == 2
    assert all(numbers == first["none"] for numbers in first.values())
    assert random.pop("control-only") == []
    assert all(bodies == random["none"] for bodies in random.values())


def test_seeds_can_share_a_cell_along_the_run_axis() -> None:
    cells = study(arms=("none",), seeds=(0, 1, 2, 3, 4), seeds_per_cell=2).cells()
    assert [(cell.settings.seed, cell.settings.num_runs) for cell in cells] == [(0, 2), (2, 2), (4, 1)]


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"environments": ("snake",)}, "'snake' is no environment; there are half_cheetah, hopper, walker, ant"),
        ({"arms": ("oracel",)}, "arm 'oracel' is none of none, known"),
        ({"tasks": ("up",)}, "tasks has 'up', each must be 'forward' or 'backward'"),
        ({"protocol": "papre"}, "protocol is 'papre', it must be 'paper', 'preview', 'pilot' or 'smoke'"),
        ({"overrides": {"learning_rate": 1}}, "overrides of learning_rate are not possible"),
        ({"overrides": {"seed": 1}}, "overrides of seed are not possible"),
        ({"overrides": {"num_cells": 4}}, "num_cells is 4, it must be a list"),
        ({"overrides": {"lr": -1}}, "lr is -1, it must be above 0"),
        ({"seeds": (1, 1)}, "seeds has 1 more than once; name each of them once"),
        ({"seeds": (0, 1, 1, 2), "seeds_per_cell": 2}, "seeds has 1 more than once"),
        ({"arms": ("none", "none")}, "arms has 'none' more than once"),
        ({"seeds": ()}, "seeds is empty"),
        ({"blocks": ({"arms": ("none",)},)}, "blocks has {.*}, each must be a Block"),
        ({"seeds_per_cell": 0}, "seeds_per_cell is 0, it must be at least 1"),
    ],
)
def test_what_cannot_be_is_named_before_anything_is_computed(fields: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        study(**fields)


def test_an_override_that_changes_nothing_where_it_is_written_is_refused() -> None:
    climbing = {"search": "gradient", "num_particles": 9}
    with pytest.raises(ValueError, match="in the overrides num_particles has no effect with search gradient"):
        study(overrides=climbing)
    with pytest.raises(ValueError, match="sigma has no effect with imagine none; leave it out"):
        study(arms=("none", "oracle"), overrides={"sigma": 0.2})
    assert study(arms=("none", "noisy"), overrides={"sigma": 0.2}).overrides  # it has one in some of the cells
    more = Block(environments=("walker",), arms=("none",), seeds=(9,), overrides={"model_lr": 0.1})
    with pytest.raises(ValueError, match="model_lr has no effect with imagine none"):
        study(arms=("known",), blocks=(more,))


def test_an_override_that_some_arms_would_not_hear_is_refused() -> None:
    """It would change what the others are, under their names, or nothing at all."""
    cases = {
        ("grounded",): {"reach": 0.5},
        ("none", "returns"): {"chosen_by": "posterior"},
        ("grounded", "grounded-governed-both"): {"individual_imagined_share": 0.1},
    }
    for arms, overrides in cases.items():
        (name,) = overrides
        with pytest.raises(ValueError, match=f"the override of {name} does not reach {arms[-1]}, as these arms set it"):
            study(arms=arms, overrides=overrides)
    same = study(arms=("none", "known"), overrides={"chosen_by": "returns"})
    assert {cell.settings.chosen_by for cell in same.cells()} == {"returns"}
    more = Block(environments=("walker",), arms=("grounded",), seeds=(9,))
    with pytest.raises(ValueError, match="the override of reach does not reach grounded"):
        study(arms=("none",), overrides={"reach": 0.5}, blocks=(more,))


@pytest.mark.parametrize(("seeds", "twice"), [((3,), "none-3"), ((4, 3), "none-3, hopper-forward-none-4")])
def test_a_seed_that_two_blocks_share_is_named_with_its_place(seeds: tuple[int, ...], twice: str) -> None:
    """Also where it is not the first of its cell, which alone names the cell's folder."""
    more = Block(environments=("hopper",), arms=("none",), seeds=seeds)
    with pytest.raises(ValueError, match=f"^hopper-forward-{twice} would be made twice; take it out of all but one b"):
        study(blocks=(more,), seeds_per_cell=2)


def test_a_first_design_is_held_against_each_body() -> None:
    one = study(overrides={"first_design": (1, 1, 1, 2)})
    assert one.cells()[0].settings.first_design == (1, 1, 1, 2)
    assert all(isinstance(factor, float) for factor in one.cells()[0].settings.first_design)
    with pytest.raises(ValueError, match=r"1.0, 2.5\), a design of hopper has 4 scale factors from 0.5 to 2.0; write"):
        study(overrides={"first_design": (1, 1, 1, 2.5)})
    with pytest.raises(ValueError, match="a design of walker has 7 scale factors"):
        study(environments=("hopper", "walker"), overrides={"first_design": (1, 1, 1, 2)})
    together = {"seeds": (0, 1), "seeds_per_cell": 2}
    two = study(**together, overrides={"first_design": (1, 1, 1, 2, 0.6, 1, 1, 1)})
    algorithm = build(HopperMorph, two.cells()[0].settings)
    assert algorithm.design_choice.first_designs.tolist() == [[[1, 1, 1, 2], [pytest.approx(0.6), 1, 1, 1]]]
    with pytest.raises(ValueError, match=r"first_design is .* from 0\.5 to 2"):
        study(**together, overrides={"first_design": (1, 1, 1, 2, 2.5, 1, 1, 1)})


def test_the_preview_has_the_papers_networks_batches_and_updates() -> None:
    preview, paper = PROTOCOLS["preview"], PROTOCOLS["paper"]
    cheaper = {"num_designs", "first_episodes", "episodes", "search"}
    assert dataclasses.replace(paper, **{name: getattr(preview, name) for name in cheaper}) == preview
    assert preview.num_designs >= 5 + 8
    assert len(STUDIES["preview"].cells()) == 4 * 5 + 2 * 3


def test_a_method_is_confirmed_by_the_study_it_was_developed_on_with_other_seeds() -> None:
    for name in ("bodies", "imagining"):
        develop, confirm = STUDIES[f"{name}-develop"], STUDIES[name]
        own = [
            {(cell.environment, cell.arm, dataclasses.replace(cell.settings, name="", seed=0)) for cell in made.cells()}
            for made in (develop, confirm)
        ]
        assert own[0] == own[1]
        assert not {*develop.seeds} & {*confirm.seeds}
    counts = [len(STUDIES[name].cells()) for name in ("bodies-develop", "bodies", "imagining-develop", "imagining")]
    assert counts == [7 * 5, 7 * 10, (8 + 3) * 5, (8 + 3) * 10]


@pytest.mark.parametrize(
    ("method", "imagined"), [("grounded", ("known", "noisy", "random")), ("returns", ("known", "noisy"))]
)
def test_an_arm_that_imagines_with_other_bodies_differs_from_its_namesake_in_the_choice_alone(
    method: str, imagined: tuple[str, ...]
) -> None:
    for imagine in imagined:
        assert ARMS[f"{method}-{imagine}"].settings == ARMS[imagine].settings | METHODS[method]


def test_the_ledger_keeps_what_is_finished_and_lets_all_else_wait(tmp_path: Path) -> None:
    cells = study().cells()
    ledger = Ledger(tmp_path / "ledger.csv", cells)
    ledger.note(cells[0].name, "finished", tries=1, seconds=2.5)
    ledger.note(cells[1].name, "running", tries=2)
    ledger.note(cells[2].name, "failed", tries=3, message='of "a", b')
    rows = {row.cell: row for row in read_ledger(tmp_path / "ledger.csv")}
    assert [rows[cell.name].state for cell in cells] == ["finished", "running", "failed", "waiting"]
    assert rows[cells[2].name].message == 'of "a", b'
    assert rows[cells[3].name].seed == 4
    again = Ledger(tmp_path / "ledger.csv", cells)
    assert again.in_state("finished") == [cells[0].name]
    assert again.in_state("waiting") == [cell.name for cell in cells[1:]]
    assert (again.entries[cells[0].name].seconds, again.entries[cells[1].name].tries) == (2.5, 2)
    with pytest.raises(ValueError, match="has the cell hopper-forward-none-4, which this study has not"):
        Ledger(tmp_path / "ledger.csv", study(seeds=(3,)).cells())


def finished_study(folder: Path, **fields: object) -> Study:
    """A study whose cells the ledger calls finished, with the settings that they were made with and nothing else."""
    made = study(seeds=(3,), **fields)
    ledger = Ledger(folder / "ledger.csv", made.cells())
    for cell in made.cells():
        own = folder / "cells" / cell.name
        own.mkdir(parents=True)
        config = {"environment": "hopper", "settings": plain(dataclasses.replace(cell.settings, out=own, threads=3))}
        (own / "config.json").write_text(json.dumps(config))
        ledger.note(cell.name, "finished", seconds=1.0)
    return made


def test_a_finished_cell_waits_again_if_it_is_gone_or_has_more_designs_to_try(tmp_path: Path) -> None:
    made = finished_study(tmp_path, overrides={"num_cells": (4,)})
    none, known = (cell.name for cell in made.cells())
    assert take_up(tmp_path, made.cells(), Resources()).in_state("finished") == [none, known]
    (tmp_path / "cells" / known / "config.json").unlink()
    (tmp_path / "cells" / known).rmdir()
    assert take_up(tmp_path, made.cells(), Resources()).in_state("waiting") == [known]
    assert [row.state for row in read_ledger(tmp_path / "ledger.csv")] == ["finished", "waiting"]
    more = study(seeds=(3,), overrides={"num_cells": (4,), "num_designs": 9})
    assert take_up(tmp_path, more.cells(), Resources()).in_state("waiting") == [none, known]


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [({"episodes": 2}, r"none-3 was made with other settings: episodes \(1 to 2\)"), ({"num_designs": 5}, "6 to 5")],
)
def test_a_finished_cell_of_another_protocol_is_not_compared_with_what_is_computed_now(
    tmp_path: Path, overrides: dict, sentence: str
) -> None:
    finished_study(tmp_path)
    with pytest.raises(ValueError, match=sentence):
        take_up(tmp_path, study(overrides=overrides).cells(), Resources())


@pytest.mark.parametrize("begun", ["finished", "waiting"])
def test_a_cell_goes_on_where_the_protocol_changed_in_what_its_arm_does_not_read(tmp_path: Path, begun: State) -> None:
    none, known = finished_study(tmp_path).cells()
    ledger = Ledger(tmp_path / "ledger.csv", [none, known])
    for cell in (none, known):
        ledger.note(cell.name, begun, tries=1)
    changed = study(seeds=(3,), overrides={"model_cells": (4, 4)}).cells()
    with pytest.raises(ValueError, match=rf"{known.name} .*other settings: model_cells"):
        take_up(tmp_path, changed, Resources())
    assert take_up(tmp_path, [changed[0], known], Resources()).in_state(begun) == [none.name, known.name]


@pytest.mark.parametrize("begun", ["finished", "waiting"])
@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"overrides": {"lr": 0.1}, "seeds": (3, 4, 5)}, r"other settings: lr \(0.0003 to 0.1\)"),
        ({"name": "other", "seeds": (4,)}, "none-3, which this study has not; name another folder"),
    ],
)
def test_a_study_that_is_refused_changes_nothing_and_the_right_one_goes_on(
    tmp_path: Path, begun: State, fields: dict, sentence: str
) -> None:
    made = finished_study(tmp_path)
    for cell in made.cells():
        Ledger(tmp_path / "ledger.csv", made.cells()).note(cell.name, begun, tries=1)
    before = (tmp_path / "ledger.csv").read_bytes()
    with pytest.raises(ValueError, match=sentence):
        take_up(tmp_path, study(**fields).cells(), Resources())
    assert (tmp_path / "ledger.csv").read_bytes() == before
    assert take_up(tmp_path, made.cells(), Resources()).in_state(begun) == [cell.name for cell in made.cells()]


@pytest.mark.parametrize("begun", ["finished", "waiting"])
def test_a_study_goes_on_on_machines_with_and_without_gpus(tmp_path: Path, begun: State) -> None:
    made = finished_study(tmp_path)
    for cell in made.cells():
        Ledger(tmp_path / "ledger.csv", made.cells()).note(cell.name, begun, tries=1)
    for resources in (Resources(gpus=0.5), Resources()):
        assert take_up(tmp_path, made.cells(), resources).in_state(begun) == [cell.name for cell in made.cells()]


def test_a_study_may_be_called_otherwise_while_its_cells_are_under_way(tmp_path: Path) -> None:
    made = finished_study(tmp_path)
    (cell, *_) = study(name="called otherwise", seeds=(3,), overrides={"num_designs": 9}).cells()
    own = tmp_path / "cells" / cell.name
    going_on = to_go_on(dataclasses.replace(cell.settings, out=own))
    assert (going_on.name, going_on.num_designs, going_on.resume) == (made.name, 9, own)


def test_rows_of_a_larger_study_that_never_came_to_them_are_dropped_and_a_damaged_ledger_is_told(
    tmp_path: Path,
) -> None:
    larger = Ledger(tmp_path / "ledger.csv", study(seeds=(3, 4)).cells())
    larger.note("hopper-forward-none-3", "running", tries=1)
    assert len(take_up(tmp_path, study(seeds=(3,)).cells(), Resources()).entries) == 2
    assert len(read_ledger(tmp_path / "ledger.csv")) == 2
    (tmp_path / "ledger.csv").write_text("cell,environment\nhopper-forward-none-3,hopper\n")
    with pytest.raises(
        ValueError, match=r"ledger.csv, line 1: found cell,environment, .*put the file back .*or delete it"
    ):
        take_up(tmp_path, study(seeds=(3,)).cells(), Resources())


def test_tables_without_a_checkpoint_are_not_begun_anew_over(tmp_path: Path) -> None:
    folder = tmp_path / "a"
    cut(folder, 5)
    shutil.rmtree(folder / "checkpoint")
    rows = (folder / "evaluations.csv").read_bytes()
    with pytest.raises(ValueError, match="has the tables of a run and no checkpoint/ to go on from"):
        to_go_on(dataclasses.replace(TINY, out=folder))
    with pytest.raises(SystemExit, match="has the tables of a run and no checkpoint/ to go on from"):
        resume(folder)
    assert (folder / "evaluations.csv").read_bytes() == rows


def test_a_folder_that_has_lost_its_config_is_not_emptied(tmp_path: Path) -> None:
    folder = tmp_path / "a"
    cut(folder, 5)
    (folder / "config.json").rename(tmp_path / "config.json")
    before = sorted(folder.rglob("*"))
    with pytest.raises(ValueError, match=r"holds .*evaluations.csv.* and no config.json; put that back from a copy"):
        to_go_on(dataclasses.replace(TINY, out=folder))
    assert sorted(folder.rglob("*")) == before


def test_what_a_process_left_that_was_killed_at_once_is_begun_anew(tmp_path: Path) -> None:
    folder = tmp_path / "a"
    folder.mkdir()
    (folder / ".new-config.json").write_text('{"settings"')
    settings = dataclasses.replace(TINY, out=folder)
    assert to_go_on(settings) == settings


def test_an_address_at_which_no_cluster_is_is_told_at_once(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"no Ray cluster answers at 127.0.0.1:1 .*or leave --ray-address away"):
        entry(["smoke", "--out", str(tmp_path / "s"), "--ray-address", "127.0.0.1:1"])


def test_a_machine_too_busy_to_start_ray_is_told_in_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**options: object) -> None:
        raise Exception("The current node timed out during startup.\nMore of it")

    monkeypatch.setattr("ray.init", refuse)
    with pytest.raises(
        SystemExit, match=r"Ray did not start .*\(The current node timed out .*\); give the same command"
    ):
        entry(["smoke", "--out", str(tmp_path / "s"), "--workers", "1"])


def test_a_ledger_grows_with_its_study(tmp_path: Path) -> None:
    Ledger(tmp_path / "ledger.csv", study(seeds=(3,)).cells()).note("hopper-forward-none-3", "finished")
    grown = Ledger(tmp_path / "ledger.csv", study().cells())
    assert grown.in_state("finished") == ["hopper-forward-none-3"]
    assert len(grown.in_state("waiting")) == 3


def test_a_cell_goes_on_where_it_was_cut_and_logs_each_try(tmp_path: Path) -> None:
    folder, log = tmp_path / "cells" / "a", tmp_path / "logs" / "a.log"
    settings = dataclasses.replace(TINY, out=folder)
    assert to_go_on(settings) == settings
    assert (tries(log), episodes_done(folder, 1)) == (0, 0)
    cut(folder, 5)
    assert episodes_done(folder, 1) == 4  # of the fifth save nothing is left but its row
    assert to_go_on(settings).resume == folder
    compute("hopper", settings, log)
    assert tries(log) == 1
    assert episodes_done(folder, 1) == all_episodes_of(settings)
    assert seconds_of(folder) > 0
    assert json.loads((folder / "config.json").read_text())["resumed"][0]["changed"] == {}


def test_a_cell_that_was_begun_with_episodes_in_python_goes_on_with_them(tmp_path: Path) -> None:
    cut(tmp_path / "python", 3)
    asked = dataclasses.replace(TINY, native_episodes=True)
    config = tmp_path / "python" / "config.json"
    assert not to_go_on(dataclasses.replace(asked, out=tmp_path / "python")).native_episodes
    written = json.loads(config.read_text())
    del written["settings"]["native_episodes"]  # of a version that had none
    config.write_text(json.dumps(written))
    assert not to_go_on(dataclasses.replace(asked, out=tmp_path / "python")).native_episodes
    written["settings"]["native_episodes"] = True
    config.write_text(json.dumps(written))
    assert to_go_on(dataclasses.replace(asked, out=tmp_path / "python")).native_episodes
    assert not to_go_on(dataclasses.replace(TINY, out=tmp_path / "python")).native_episodes


@pytest.mark.parametrize("name", ["../elsewhere", "", "a/b", ".hidden"])
def test_a_name_that_is_no_folder_of_its_own_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=r"the study's name is .*; letters, digits, dots and hyphens name a folder"):
        study(name=name)


@pytest.mark.parametrize("written", [{}, {"native_episodes": False}, {"native_episodes": True}])
def test_a_cell_with_episodes_in_python_is_finished_for_a_protocol_that_has_native_ones(
    tmp_path: Path, written: dict[str, bool]
) -> None:
    """Resuming writes all settings down, also one that the version it was begun with had not."""
    config = tmp_path / "config.json"
    settings = plain(TINY)
    del settings["native_episodes"]
    config.write_text(json.dumps({"environment": "hopper", "settings": settings | written}))
    assert still_finished(dataclasses.replace(TINY, native_episodes=True), tmp_path)
    if written.get("native_episodes"):
        with pytest.raises(ValueError, match=r"native_episodes \(True to False\)"):
            still_finished(TINY, tmp_path)
    else:
        assert still_finished(TINY, tmp_path)


def test_a_finished_cell_of_before_a_setting_has_its_default(tmp_path: Path) -> None:
    settings = {name: value for name, value in plain(TINY).items() if name not in LATER}
    (tmp_path / "config.json").write_text(json.dumps({"environment": "hopper", "settings": settings}))
    assert still_finished(TINY, tmp_path)
    for changed in ({"chosen_by": "returns"}, {"governed": True}, {"value_states": "matched"}):
        ((name, value),) = changed.items()
        was = getattr(TINY, name)
        with pytest.raises(ValueError, match=rf"made with other settings: {name} \({was!r} to {value!r}\)"):
            still_finished(dataclasses.replace(TINY, **changed), tmp_path)


def all_episodes_of(settings: Settings) -> int:
    return all_episodes(dataclasses.replace(study().cells()[0], settings=settings))


def test_a_cell_that_was_begun_with_other_settings_is_refused_by_name_and_logged(tmp_path: Path) -> None:
    folder, log = tmp_path / "a", tmp_path / "a.log"
    cut(folder, 2)
    with pytest.raises(ValueError, match=r"begun with other settings: lr \(0.0003 to 0.1\)"):
        compute("hopper", dataclasses.replace(TINY, out=folder, lr=0.1), log)
    assert "begun with other settings" in log.read_text()


def test_what_a_process_had_not_finished_when_it_was_killed_is_in_nobodys_way(tmp_path: Path) -> None:
    (tmp_path / ".new-config.json").write_text("{")
    compute(
        "hopper", dataclasses.replace(TINY, out=tmp_path, num_designs=1, first_episodes=1), tmp_path.with_suffix(".log")
    )
    assert episodes_done(tmp_path, 1) == 1
    assert not (tmp_path / ".new-config.json").exists()


def test_the_study_of_the_readme_is_one(tmp_path: Path) -> None:
    readme = (Path(__file__).parents[3] / "README.md").read_text()
    (tmp_path / "mine.json").write_text(readme.split("```json\n")[1].split("```")[0])
    cells = from_json(tmp_path / "mine.json").cells()
    assert [cell.arm for cell in cells] == ["none", "oracle"] * 3
    assert {cell.settings.episodes for cell in cells} == {20}
