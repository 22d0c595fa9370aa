"""``--method``: a name for a way of choosing bodies, which moves defaults."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest

from coim.experiments.run.command_line import parse
from coim.experiments.run.settings import METHODS, PRESETS, Settings, plain
from coim.experiments.study.arms import ARMS


@pytest.mark.parametrize("method", METHODS)
def test_a_method_moves_defaults_and_options_win_over_it(method: str) -> None:
    plain = parse("prog", "", ["--method", method])
    assert plain == dataclasses.replace(PRESETS["paper"], **METHODS[method])
    assert parse("prog", "", ["--method", method, "--value-over", "start"]).value_over == "start"


def test_the_papers_method_is_the_default_of_its_protocol_and_returns_that_of_a_first_look() -> None:
    assert parse("prog", "", []) == parse("prog", "", ["--method", "paper"])
    assert parse("prog", "", ["--preset", "quick"]) == parse("prog", "", ["--preset", "quick", "--method", "returns"])
    assert parse("prog", "", ["--preset", "quick", "--method", "paper"]).chosen_by == "value"


@pytest.mark.parametrize("method", ["grounded", "returns"])
def test_an_arm_of_its_name_has_its_settings(method: str) -> None:
    given = {"imagine": "none"} | METHODS[method]
    assert dataclasses.replace(Settings(), **ARMS[method].settings) == dataclasses.replace(Settings(), **given)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--method", "guessed"], "guessed"),
        (["--widening", "0.1"], "--widening is 0.1 without a --reach that it could widen"),
        (["--method", "grounded", "--bodies", "random"], "--method grounded has no effect with --bodies random"),
    ],
)
def test_what_would_change_nothing_is_refused(words: list[str], sentence: str, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit):
        parse("prog", "", words)
    assert sentence in " ".join(capsys.readouterr().err.replace("│", " ").split())


def test_a_run_that_is_resumed_keeps_its_method(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"environment": "hopper", "settings": plain(Settings())}))
    assert parse("prog", "", ["--resume", str(tmp_path), "--method", "paper"]).chosen_by == "value"
    with pytest.raises(ValueError, match="chosen_by"):
        parse("prog", "", ["--resume", str(tmp_path), "--method", "grounded"])
