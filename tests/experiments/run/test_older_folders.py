"""Folders of earlier versions are read under the names of settings of today, whoever reads them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from coim.experiments.run.records import read_records
from coim.experiments.run.resume import saved_settings
from coim.run_folder import RENAMED, read_config

ROOT = Path(__file__).parents[3]
CELLS = ROOT / "docs" / "results" / "preview" / "cells"


@pytest.mark.parametrize(("arm", "imagine"), [("none", "none"), ("noisy", "noisy")])
def test_every_reader_finds_the_setting_under_its_name_of_today(arm: str, imagine: str) -> None:
    folder = CELLS / f"hopper-forward-{arm}-0"
    assert json.loads((folder / "config.json").read_text())["settings"]["designs"] == imagine
    (record,) = read_records([folder])
    for settings in (read_config(folder)["settings"], record.config["settings"], vars(saved_settings(folder))):
        assert settings["imagine"] == imagine
        assert not RENAMED.keys() & settings.keys()


def test_one_function_reads_the_settings_of_a_run() -> None:
    reading = ('"config.json").read_text(', '"config.json").open(', '"config.json").read_bytes(')
    sources = [path for path in (ROOT / "coim").rglob("*.py") if any(way in path.read_text() for way in reading)]
    assert [str(path.relative_to(ROOT)) for path in sources] == ["coim/run_folder.py"]
