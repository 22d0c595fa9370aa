"""A study in small: enough for its figures and to go on with, and nothing of the machine."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from coim.experiments.commands.archive import main
from coim.experiments.figures.write import write_figures
from coim.experiments.run.settings import plain
from coim.experiments.study.archive import archive
from coim.experiments.study.definition import Study, to_json
from coim.experiments.study.ledger import Ledger
from coim.experiments.study.ray_scheduler import Resources, take_up
from coim.experiments.study.runs import read_runs
from tests.experiments.made_up_study import read_table, write_cell, write_table

STUDY = Study(
    name="made-up",
    environments=("hopper",),
    arms=("none", "known"),
    seeds=(0, 1),
    protocol="smoke",
    overrides={"num_designs": 4},
)
UNDER_WAY = "hopper-forward-known-1"
RETURNS = {"none-0": [1, 2, 3, 4], "known-0": [2, 3, 4, 5], "none-1": [3, 4, 5, 7], "known-1": [4, 5]}


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """Three runs that are over and one under way, one retrained design, one measured run."""
    folder = tmp_path / "study"
    for cell in STUDY.cells():
        out = folder / "cells" / cell.name
        settings = plain(cell.settings) | {"out": str(out)}
        write_cell(folder, cell.name, RETURNS[cell.name.removeprefix("hopper-forward-")], **settings)
        (out / "checkpoint").mkdir()
    ledger = Ledger(folder / "ledger.csv", STUDY.cells())
    for cell in STUDY.cells():
        ledger.note(cell.name, "running" if cell.name == UNDER_WAY else "finished", tries=1, seconds=9.0)
    write_cell(folder, "hopper-forward-none-0-run0-design3", [1.5], part="retrained/cells", num_designs=1)
    line = {"folder": "hopper-forward-none-0-run0-design3", "environment": "hopper", "task": "forward", "arm": "none"}
    line |= {"cell": "hopper-forward-none-0", "seed": "0", "run": "0", "design": "3", "xi": "1 1", "found_return": "3"}
    line |= {"over": "2", "planned": "2"}
    write_table(folder / "retrained" / "designs.csv", list(line), [list(line.values())])
    measured = write_cell(folder, "model_error", [1, 2, 3, 4], part=".")
    config = json.loads((measured / "config.json").read_text())
    config |= {"resumed": [{"at": "now", "changed": {"out": ["a", str(measured)], "num_designs": [3, 4]}}]}
    (measured / "config.json").write_text(json.dumps(config | {"wandb_id": "secret", "environment": "hopper"}))
    return folder


@pytest.mark.usefixtures("undrawn")
def test_the_figures_of_an_archive_are_those_of_the_study_without_what_was_under_way(
    study: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    main([str(study), str(tmp_path / "kept")])
    assert "5 runs kept" in capsys.readouterr().out
    write_figures(study), write_figures(tmp_path / "kept")
    for name in ("statistics_arms", "statistics_pairs", "figure_2_retrained"):
        ours, theirs = (read_table(folder / "figures" / f"{name}.csv") for folder in (study, tmp_path / "kept"))
        assert ours == theirs
    rows = read_table(tmp_path / "kept" / "figures" / "figure_1_best_returns.csv")
    assert {(row["arm"], row["seed"]) for row in rows if row["series"] == "run"} == {
        ("none", "0"), ("none", "1"), ("known", "0"),
    }  # fmt: skip
    assert "3 of 4 runs are over, 0 under way, 1 to come" in (tmp_path / "kept" / "figures" / "README.md").read_text()


def test_nothing_of_the_machine_is_kept(study: Path, tmp_path: Path) -> None:
    main([str(study), str(tmp_path / "kept")])
    files = [path for path in (tmp_path / "kept").rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".json", ".csv"}
    for path in files:
        assert str(tmp_path) not in path.read_text()
        assert "secret" not in path.read_text()
    config = json.loads((tmp_path / "kept" / "cells" / "hopper-forward-none-0" / "config.json").read_text())
    assert config["settings"]["out"] == "cells/hopper-forward-none-0"
    config = json.loads((tmp_path / "kept" / "model_error" / "config.json").read_text())
    assert config["resumed"] == [{"at": "now", "changed": {"num_designs": [3, 4]}}]


def test_a_study_goes_on_from_its_archive_with_what_was_not_over(study: Path, tmp_path: Path) -> None:
    main([str(study), str(tmp_path / "kept")])
    ledger = take_up(tmp_path / "kept", STUDY.cells(), Resources())
    assert ledger.in_state("waiting") == [UNDER_WAY]
    assert not (tmp_path / "kept" / "cells" / UNDER_WAY).exists()
    assert ledger.entries[UNDER_WAY].tries == 0


def test_archiving_again_adds_what_was_finished_since(study: Path, tmp_path: Path) -> None:
    main([str(study), str(tmp_path / "kept")])
    folder = study / "cells" / UNDER_WAY
    settings = json.loads((folder / "config.json").read_text())["settings"]
    folder.rename(tmp_path / "old")
    write_cell(study, UNDER_WAY, [4, 5, 6, 7], **settings)
    main([str(study), str(tmp_path / "kept")])
    rows = read_table(tmp_path / "kept" / "cells" / UNDER_WAY / "designs.csv")
    assert [float(row["best_return"]) for row in rows] == [4, 5, 6, 7]


def test_an_archive_does_not_mix_runs_of_a_study_that_grew_with_those_of_before(study: Path, tmp_path: Path) -> None:
    main([str(study), str(tmp_path / "kept")])
    path = study / "cells" / "hopper-forward-none-0" / "config.json"
    config = json.loads(path.read_text())
    path.write_text(json.dumps(config | {"settings": config["settings"] | {"num_designs": 6}}))  # two more to try
    main([str(study), str(tmp_path / "kept")])
    assert not (tmp_path / "kept" / "cells" / "hopper-forward-none-0").exists()
    assert (tmp_path / "kept" / "cells" / "hopper-forward-none-1").exists()
    states = {row["cell"]: row["state"] for row in read_table(tmp_path / "kept" / "ledger.csv")}
    assert states["hopper-forward-none-0"] == "waiting"


def test_a_run_that_is_over_is_finished_whatever_the_ledger_says_and_a_message_is_left_out(
    study: Path, tmp_path: Path
) -> None:
    cells = STUDY.cells()
    ledger = Ledger(study / "ledger.csv", cells)
    ledger.note(cells[0].name, "failed", message=f"{tmp_path} was full")
    main([str(study), str(tmp_path / "kept")])
    row = read_table(tmp_path / "kept" / "ledger.csv")[0]
    assert (row["cell"], row["state"], row["message"]) == (cells[0].name, "finished", "")


def test_a_run_that_was_given_up_stays_so_and_is_tried_again_by_who_goes_on(study: Path, tmp_path: Path) -> None:
    Ledger(study / "ledger.csv", STUDY.cells()).note(UNDER_WAY, "failed", tries=3, message=f"OSError in {tmp_path}")
    main([str(study), str(tmp_path / "kept")])
    row = {row["cell"]: row for row in read_table(tmp_path / "kept" / "ledger.csv")}[UNDER_WAY]
    assert (row["state"], row["tries"], row["message"]) == ("failed", "3", "")
    assert "1 failed" in read_runs(tmp_path / "kept").in_words(["none", "known"])
    assert Ledger(tmp_path / "kept" / "ledger.csv", STUDY.cells()).in_state("waiting") == [UNDER_WAY]


def test_what_cannot_be_kept_is_told(study: Path, tmp_path: Path) -> None:
    other = write_cell(tmp_path / "other", "hopper-forward-none-0", [9] * 4).parents[1]
    (other / "cells" / "hopper-forward-none-0" / "checkpoint").mkdir()
    before = {path: path.read_bytes() for path in other.rglob("*.csv")}
    (tmp_path / "file").touch()
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "study.json").write_text('{"name": "theirs"}')
    (study / "study.json").write_text(to_json(STUDY))
    for where, target, sentence in (
        (tmp_path, tmp_path / "kept", "is no study's folder: it has no cells/"),
        (study, study / "kept", "is in the study's own folder"),
        (study, other, "is the folder of a study with checkpoints, no archive"),
        (study, tmp_path / "theirs", f"keeps another study, 'theirs', and this one is {STUDY.name!r}"),
        (study, study / ".." / "file", "is a file; name a folder"),
    ):
        with pytest.raises(SystemExit, match=sentence):
            main([str(where), str(target)])
    assert before == {path: path.read_bytes() for path in other.rglob("*.csv")}
    write_cell(tmp_path / "young", "hopper-forward-none-0", [1])
    with pytest.raises(SystemExit, match=r"no run of .*young is over yet"):
        main([str(tmp_path / "young"), str(tmp_path / "kept")])
    assert not (tmp_path / "kept").exists()


def test_runs_that_an_archive_has_from_elsewhere_are_not_deleted(study: Path, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    archive(study, kept)
    write_cell(kept, "hopper-forward-none-7", [1, 2, 3, 4])
    before = {path: path.read_bytes() for path in kept.rglob("*.csv")}
    with pytest.raises(
        ValueError, match=r"keeps 1 run\(s\) that .* does not have, such as cells/hopper-forward-none-7; they"
    ):
        archive(study, kept)
    assert before == {path: path.read_bytes() for path in kept.rglob("*.csv")}


def test_what_its_user_evaluated_stays_where_it_is(study: Path, tmp_path: Path) -> None:
    cell = Path("cells") / "hopper-forward-none-0"
    for name in ("evaluation.csv", "evaluation-2.csv"):
        (study / cell / name).write_text("source\n/home/somebody/run\n")
    archive(study, tmp_path / "kept")
    assert {path.name for path in (tmp_path / "kept" / cell).iterdir()} == {
        "config.json",
        "designs.csv",
        "evaluations.csv",
    }
