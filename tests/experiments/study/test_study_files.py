"""A study as a file: read as it was written, or refused in a sentence before there is a folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from coim.experiments.commands.study import main as entry
from coim.experiments.study.definition import Block, Study, from_json, to_json

LEAST = {"name": "s", "environments": ["hopper"], "arms": ["none"], "seeds": [0], "protocol": "smoke"}
BLOCK = {"environments": ["walker"], "arms": ["none"], "seeds": [0]}


def test_a_study_is_read_as_it_was_written(tmp_path: Path) -> None:
    more = Block(environments=("half_cheetah",), arms=("noisy",), seeds=(0,), overrides={"num_cells": (4, 4)})
    written = Study(
        name="s",
        environments=("hopper",),
        arms=("none", "known"),
        seeds=(3, 4),
        protocol="smoke",
        blocks=(more,),
        overrides={"lr": 0.1},
    )
    (tmp_path / "study.json").write_text(to_json(written))
    read = from_json(tmp_path / "study.json")
    assert read.cells() == written.cells()
    assert read.cells()[2].settings.num_cells == (4, 4)
    assert to_json(read) == to_json(written)


def test_a_whole_number_may_stand_for_a_float(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps(LEAST | {"overrides": {"alpha": 1, "first_design": [1, 1, 1, 2]}}))
    settings = from_json(path).cells()[0].settings
    assert repr((settings.alpha, settings.first_design)) == "(1.0, (1.0, 1.0, 1.0, 2.0))"


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"b.json cannot be read \(No such file"):
        from_json(tmp_path / "b.json")


WRONG: list[tuple[Any, str]] = [
    (
        [LEAST],
        "it is [{'arms': ['none'], 'environments': ['hopper'], 'name': 's', 'protocol': 'smoke', ...}], it must be a ",
    ),
    (None, "it is None, it must be a mapping of names to values"),
    (3, "it is 3, it must be a mapping of names to values"),
    ({"seed": 1}, "there is no seed; similar names are seeds"),
    ({"name": "a"}, "it has no environments, arms, seeds; add what is missing"),
    (LEAST | {"name": 3}, "name is 3, it must be a string"),
    (LEAST | {"protocol": ["smoke"]}, "protocol is ['smoke'], it must be 'paper', 'preview', 'pilot' or 'smoke'"),
    (LEAST | {"environments": "hopper"}, "environments is 'hopper', it must be a list"),
    (LEAST | {"environments": [["hopper"]]}, "environments has ['hopper'], each must be a string"),
    (LEAST | {"environments": []}, "environments is empty"),
    (LEAST | {"arms": []}, "arms is empty"),
    (LEAST | {"tasks": []}, "tasks is empty"),
    (LEAST | {"seeds": []}, "seeds is empty; name at least one entry"),
    (LEAST | {"seeds": 3}, "seeds is 3, it must be a list"),
    (LEAST | {"seeds": "012"}, "seeds is '012', it must be a list"),
    (LEAST | {"seeds": ["0"]}, "seeds has '0', each must be a whole number"),
    (LEAST | {"seeds": [0.5]}, "seeds has 0.5, each must be a whole number"),
    (LEAST | {"seeds": [True]}, "seeds has True, each must be a whole number"),
    (LEAST | {"seeds": [0, -1]}, "seeds has -1, each must be at least 0"),
    (LEAST | {"seeds": [1, 1]}, "seeds has 1 more than once; name each of them once"),
    (LEAST | {"seeds_per_cell": 1.5}, "seeds_per_cell is 1.5, it must be a whole number"),
    (LEAST | {"overrides": None}, "overrides is None, it must be a mapping of names to values"),
    (LEAST | {"overrides": ["lr"]}, "overrides is ['lr'], it must be a mapping of names to values"),
    (LEAST | {"overrides": {"episodes": "20"}}, "episodes is '20', it must be a whole number"),
    (LEAST | {"overrides": {"num_designs": 0}}, "num_designs is 0, it must be at least 1"),
    (LEAST | {"overrides": {"first_design": [3, 1, 1, 1]}}, "a design of hopper has 4 scale factors from 0.5 to 2.0"),
    (
        LEAST | {"blocks": BLOCK},
        "'environments': ['walker'], 'seeds': [0]}, it must be a list",
    ),
    (LEAST | {"blocks": ["walker"]}, "blocks has 'walker', each must be a mapping of names to values"),
    (LEAST | {"blocks": [BLOCK, {"arms": ["none"]}]}, "in block 2: it has no environments, seeds; add what is missing"),
    (LEAST | {"blocks": [BLOCK | {"seed": 1}]}, "in block 1: there is no seed; similar names are seeds"),
    (LEAST | {"blocks": [BLOCK | {"who": 1}]}, "there is no who; there are environments, arms, seeds, tasks, "),
    (LEAST | {"blocks": [BLOCK | {"overrides": {"compile": "yes"}}]}, "compile is 'yes', it must be true or false"),
    (LEAST | {"blocks": [BLOCK, BLOCK]}, "walker-forward-none-0 would be made twice; take it out of all but one block"),
]


@pytest.mark.parametrize(("written", "sentence"), WRONG)
def test_a_file_that_is_no_study_is_refused_in_a_sentence_and_leaves_no_folder(
    tmp_path: Path, written: object, sentence: str
) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps(written))
    with pytest.raises(SystemExit) as stop:
        entry([str(path), "--out", str(tmp_path / "s")])
    assert str(stop.value.code).startswith(f"{path} is no study: ")
    assert sentence in str(stop.value.code)
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_is_no_json_is_no_study(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("[")
    with pytest.raises(ValueError, match=r"a.json is no study: Invalid JSON: EOF while parsing a list at line 1"):
        from_json(tmp_path / "a.json")
