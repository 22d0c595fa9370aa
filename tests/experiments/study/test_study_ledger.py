"""The ledger of a study: what is finished stays, what was cut goes on, what does not belong is refused."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import pytest
from interrupted_runs import cut
from small_study import study
from tiny_runs import TINY, resume

from coim.experiments.commands.study import main as entry
from coim.experiments.run.resume import LATER, still_finished, to_go_on
from coim.experiments.run.settings import Settings, plain
from coim.experiments.study.cell import compute, episodes_done, seconds_of, tries
from coim.experiments.study.definition import Study
from coim.experiments.study.ledger import Ledger, State, read_ledger
from coim.experiments.study.ray_scheduler import Resources, all_episodes, take_up


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
