"""Every tutorial of the site runs from top to bottom, as it stands."""

from __future__ import annotations

import runpy
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

DOCS = Path(__file__).parents[2] / "docs"
SCRIPTS = sorted((DOCS / "tutorials").glob("*.py"))


@pytest.fixture(autouse=True)
def figures() -> Iterator[None]:
    """Draw without a screen, and leave no figure behind."""
    plt.switch_backend("agg")
    yield
    plt.close("all")


def test_the_site_lists_every_tutorial() -> None:
    assert sorted(runpy.run_path(str(DOCS / "reading_order.py"))["TUTORIALS"]) == [path.stem for path in SCRIPTS]


def test_settings_of_the_gallery_stand_in_code_where_they_are_left_out_of_the_page() -> None:
    blocks = [block for path in SCRIPTS for block in path.read_text().split("\n# %%\n")[1:]]
    text = [line for block in blocks for line in takewhile(lambda line: line.startswith("#"), block.splitlines())]
    assert text
    assert not [line for line in text if "sphinx_gallery_" in line]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_a_tutorial_runs(script: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    runpy.run_path(str(script))
    drawn = [axes for number in plt.get_fignums() for axes in plt.figure(number).axes]
    assert all(axes.has_data() for axes in drawn)
