"""Sections on how bodies were chosen and on what was imagined, on runs that were made up."""

from __future__ import annotations

from pathlib import Path

import pytest

from coim.experiments.report.evidence import expectations, worth
from coim.experiments.report.imagined import imagination
from coim.experiments.report.page import Section
from coim.experiments.run.records import read_records
from tests.experiments.report.made_up_run import write_run

RETURNS = (100.0, 200.0, 300.0, 500.0, 150.0, 300.0)
TOLD = {"expected": [None, None, None, 400.0, 300.0, 300.0], "deviation": [None, None, None, 100.0, 50.0, 50.0]}


def shown(section: Section | None) -> Section:
    """A section that has a picture, with a caption of at most 60 words and at most ten columns."""
    assert section is not None
    assert section.figure is not None
    assert 0 < len(section.caption.split()) <= 60
    assert all(len(row) == len(table.head) <= 10 for table in section.tables for row in table.rows)
    assert "nan" not in section.alt.lower()
    return section


def test_every_body_is_shown_with_its_interval_and_how_many_held(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", RETURNS, told=TOLD, chosen_by="returns")
    section = shown(expectations(read_records([folder])))
    assert section.notes[0].startswith(
        "After the first bodies, 2 of 3 best returns (67 %) lie within their 90 % interval. Of intervals that"
    )
    assert "rank correlation not defined (n = 3 designs after the first ones, four" in section.notes[1]
    (table,) = section.tables
    assert table.head == ["", "kind", "expected", "5 %", "95 %", "best return", "within"]
    assert table.rows[1] == ["design 5", "random", "300", "217.8", "382.2", "150", "no"]  # 300 -+ 1.645 x 50


def test_bodies_chosen_by_eq_5_have_no_interval(tmp_path: Path) -> None:
    records = read_records([write_run(tmp_path / "run", RETURNS)])
    assert expectations(records) is None
    beginning = write_run(tmp_path / "new", RETURNS[:3], chosen_by="returns")
    section = expectations(read_records([beginning]))
    assert section is not None
    assert section.figure is None
    assert "three returns are needed" in section.notes[0]


def test_folders_are_compared_by_what_was_expected(tmp_path: Path) -> None:
    folders = [
        write_run(tmp_path / "returns", RETURNS, told=TOLD, chosen_by="returns"),
        write_run(tmp_path / "value", RETURNS),
    ]
    section = shown(expectations(read_records(folders)))
    assert section.notes[0].startswith("returns: After the first bodies, 2 of 3 best returns")
    assert section.notes[-1].startswith("value: no return was expected")


def test_the_search_is_worth_optimised_minus_random_bodies(tmp_path: Path) -> None:
    one = write_run(tmp_path / "one", (*RETURNS, 250.0))
    section = shown(worth(read_records([one])))
    ((name, *cells),) = section.tables[0].rows
    assert (name, cells[:5]) == ("run 0", ["2", "400", "2", "200", "200"])
    assert cells[5] == "-491.9 to 891.9"  # 200 -+ t x sqrt(100^2 + 50^2), t = 6.19 of 1.47 degrees of freedom
    assert section.notes[0].startswith("the interval of one run reaches 692 to each side")
    assert section.notes[1].startswith("The random bodies were built later on the mean")  # the fifth and seventh
    balanced = shown(worth(read_records([write_run(tmp_path / "balanced", (*RETURNS, 250.0, 400.0))])))
    assert not any("built later" in note for note in balanced.notes)
    fleet = write_run(tmp_path / "fleet", (*RETURNS, 250.0), (*RETURNS, 450.0))
    section = shown(worth(read_records([fleet])))
    assert section.tables[0].rows[-1][0] == "mean of 2 runs"
    assert section.tables[0].rows[-1][-2] == "150"
    assert "only several runs can tell" in section.notes[-1]


def test_folders_that_differ_in_their_seed_alone_have_a_mean_over_all_their_runs(tmp_path: Path) -> None:
    folders = [write_run(tmp_path / str(seed), (*RETURNS, last), seed=seed) for seed, last in enumerate((250.0, 450.0))]
    other = write_run(tmp_path / "other", (*RETURNS, 250.0), seed=0, chosen_by="returns")
    rows = shown(worth(read_records([*folders, other]))).tables[0].rows
    assert [row[0] for row in rows][3:] == ["mean of 2 runs in 2 folders that differ in their seed alone"]
    assert rows[-1][-2:] == ["150", "-485.3 to 785.3"]  # of 200 and 100: 150 -+ 12.7 x 50


def test_a_folder_that_was_copied_or_has_no_gain_yet_makes_no_mean_over_seeds(tmp_path: Path) -> None:
    whole = (*RETURNS, 250.0)
    folders = [write_run(tmp_path / name, whole, seed=0) for name in ("run", "copy")]
    folders.append(write_run(tmp_path / "begun", RETURNS[:4], seed=1))
    names = [row[0] for row in shown(worth(read_records(folders))).tables[0].rows]
    assert names == ["run, run 0", "copy, run 0"]


def test_without_a_search_there_is_nothing_to_compare(tmp_path: Path) -> None:
    found = {
        "bodies were not searched": write_run(tmp_path / "random", RETURNS, bodies="random"),
        "no run has both": write_run(tmp_path / "begun", RETURNS[:4]),
    }
    for words, folder in found.items():
        for name in ("designs.csv", "evaluations.csv") if words == "bodies were not searched" else ():
            (folder / name).write_text((folder / name).read_text().replace("optimised", "random"))
        section = worth(read_records([folder]))
        assert section.figure is None
        assert section.notes[0].startswith(words)


@pytest.mark.parametrize("dream", ["ensemble", "simulator"])
def test_every_arm_that_imagines_shows_its_impossible_pairs(tmp_path: Path, dream: str) -> None:
    """Also where the simulator imagines, and there is no error of a model."""
    measured = {"impossible": [0.5] * 6} | ({"model_error": [0.3] * 6} if dream == "ensemble" else {})
    folder = write_run(tmp_path / "run", RETURNS, measured=measured, imagine="random", dream=dream)
    section = shown(imagination(read_records([folder])))
    assert "5 cm of the body in the floor" in section.caption
    assert "in the last episode: run: 0.5" in section.alt


def test_a_run_that_did_not_count_impossible_pairs_says_so(tmp_path: Path) -> None:
    old = imagination(read_records([write_run(tmp_path / "old", RETURNS, imagine="known")]))
    assert old is not None
    assert old.figure is None
    assert old.notes[0].startswith("impossible pairs were not counted")
    assert imagination(read_records([write_run(tmp_path / "none", RETURNS)])) is None


def test_a_governed_run_says_how_much_was_imagined_and_why_not_more(tmp_path: Path) -> None:
    measured = {
        "impossible": [0.0] * 6,
        "model_error": [1.2, 0.9, 0.7, 0.4, 0.3, 0.2],
        "imagined_share": [0.0, 0.0, 0.0, 0.125, 0.0, 0.175],
    }
    folder = write_run(tmp_path / "run", RETURNS, measured=measured, imagine="known", governed=True)
    section = shown(imagination(read_records([folder])))
    assert section.notes[0] == (
        "run 0: of 6 episodes 0.12 to 0.17 of a batch in 2; the error was 0.7 or more in 3, the members disagreed on "
        "most rows in 1."
    )
