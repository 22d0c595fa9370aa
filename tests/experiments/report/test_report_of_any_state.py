"""The page of a run in any state: going on, torn, of an older version, with numbers that are none, or no run at all."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from report_page import PICTURES, check

from coim import HalfCheetahMorph
from coim.experiments.commands.report import main
from coim.experiments.frames import designs_of
from coim.experiments.report.run_report import write_report
from coim.experiments.run.records import read_record


def under_way(folder: Path, copy: Path, *, rows: int, torn: str = "") -> Path:
    """A copy as it was after that many rows of each table, and a piece of the next."""
    shutil.copytree(folder, copy)
    for name in ("evaluations.csv", "metrics.csv", "designs.csv"):
        lines = (copy / name).read_text().splitlines(keepends=True)
        kept = lines[: 1 + (0 if name == "designs.csv" else rows)]
        (copy / name).write_text("".join(kept) + torn)
    return copy


@pytest.mark.parametrize("rows", [1, 2, 4])
def test_a_run_that_is_going_on_has_a_page(reported: Path, tmp_path: Path, rows: int) -> None:
    folder = under_way(reported / "fleet", tmp_path / "run", rows=rows, torn="2,1,fir")
    page = check(write_report([folder]))
    assert f"at design {1 if rows < 4 else 2} of 7, episode 1" in page.words
    assert "No design has both a prediction and a return yet" in page.words


@pytest.mark.usefixtures("undrawn")
def test_a_run_from_before_there_were_metrics_has_a_page(reported: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(reported / "one", tmp_path / "run")
    (folder / "metrics.csv").unlink()
    page = check(write_report([folder]))
    assert len(page.images) == len(PICTURES) - 3
    assert page.words.count("The folder has no metrics.csv") == 2
    assert "impossible pairs were not counted" in page.words


def test_numbers_that_are_none_are_gaps(reported: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(reported / "fleet", tmp_path / "run")
    kept = ("run", "design", "kind", "episode", "env_steps", "diverged")
    for name in ("evaluations.csv", "metrics.csv", "designs.csv"):
        head, *rows = (folder / name).read_text().splitlines()
        columns = head.split(",")
        broken = [
            row if row[0] != "1" else ",".join(
                cell if column in kept or column.startswith(("xi", "sec"))
                else "nan" for column, cell in zip(columns, row.split(","))
            ) for row in rows
        ]  # fmt: skip
        (folder / name).write_text("\n".join([head, *broken]) + "\n")
    page = check(write_report([folder]))
    assert "mean of 2 runs" in page.words
    best = read_record(folder, "").best
    assert best.index.tolist() == [0, 2]


def test_the_tables_in_docs_that_count_the_entries_are_read_with_the_names_of_the_body() -> None:
    kept = Path(__file__).parents[3] / "docs" / "results" / "preview" / "cells" / "half_cheetah-forward-none-0"
    record = read_record(kept, kept.name)
    assert record.design_names == HalfCheetahMorph.design_names()
    assert designs_of(record.designs).shape[1] == 6


def test_what_is_no_run_gets_a_sentence(reported: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    other = shutil.copytree(reported / "one", tmp_path / "other")
    config = json.loads((other / "config.json").read_text())
    (other / "config.json").write_text(json.dumps(config | {"environment": "walker"}))
    empty = under_way(reported / "one", tmp_path / "empty", rows=0)
    nothing = tmp_path / "nothing"
    nothing.mkdir()
    torn = shutil.copytree(reported / "one", tmp_path / "torn")
    (torn / "config.json").write_text('{"environment": ')
    cases = {
        "nothing holds no run: ": [nothing],
        "missing holds no run": [tmp_path / "missing"],
        "evaluations.csv has no rows": [empty],
        "hold runs of hopper and walker; compare runs of one environment": [reported / "one", other],
        "config.json is damaged": [torn],
        "no folder is named": [],
    }
    for sentence, folders in cases.items():
        with pytest.raises(SystemExit) as stop:
            main([str(folder) for folder in folders])
        said = f"{stop.value.code}"
        assert sentence in said
        assert "\n" not in said
    assert not (nothing / "report.html").exists()


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("name", ["evaluations.csv", "designs.csv", "metrics.csv"])
def test_a_page_is_not_made_of_half_a_table(
    reported: Path, tmp_path: Path, capsys: pytest.CaptureFixture, name: str
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(reported / "fleet", folder, ignore=shutil.ignore_patterns("report.html", "checkpoint"))
    text = (folder / name).read_text()
    (folder / name).write_text("\ufeff" + text)
    main([str(folder)])
    page = (folder / "report.html").read_text()
    head, first, second, *others = text.splitlines(keepends=True)
    torn = {2: [head, first[:9] + "\n", second, *others], 3: [head, first, second.replace(",", ",x,", 1), *others]}
    for line, lines in torn.items():
        (folder / name).write_text("".join(lines))
        with pytest.raises(SystemExit, match=rf"{name}, line {line}: found .*, expected") as stop:
            main([str(folder)])
        assert "\n" not in str(stop.value)
    assert (folder / "report.html").read_text() == page
