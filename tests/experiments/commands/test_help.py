"""The help of each command: the names that it takes, in words without the markup of the source."""

from __future__ import annotations

from importlib import import_module

import pytest

from coim.envs import BODIES
from coim.experiments.command import COMMANDS, as_help
from coim.experiments.study.named import STUDIES

NAMES = {"run": BODIES, "model-error": BODIES, "study": STUDIES, "watch": ("best", "top5", "all")}


def help_of(word: str, capsys: pytest.CaptureFixture, *before: str) -> str:
    """What a command prints with ``--help`` behind some words."""
    try:
        import_module(f"coim.experiments.commands.{word.replace('-', '_')}").main([*before, "--help"])
    except SystemExit as end:
        if end.code:
            raise
    return capsys.readouterr().out


@pytest.mark.parametrize("word", COMMANDS)
def test_the_help_has_no_markup_and_lists_the_names_that_a_command_takes(
    word: str, capsys: pytest.CaptureFixture
) -> None:
    shown = help_of(word, capsys)
    assert shown
    assert [mark for mark in ("`", "**", "coim.experiments") if mark in shown] == []
    for name in NAMES.get(word, ()):
        assert name in shown


def test_the_help_of_a_run_lists_the_choices_of_its_settings(capsys: pytest.CaptureFixture) -> None:
    shown = help_of("run", capsys, "hopper")
    assert "`" not in shown
    assert "--imagine {known,noisy,random,none}" in shown


def test_a_docstring_becomes_help() -> None:
    assert as_help("Films of ``runs/A``, see `Ray <https://docs.ray.io>`_ and :func:`film`.") == (
        "Films of runs/A, see Ray (https://docs.ray.io) and film."
    )
