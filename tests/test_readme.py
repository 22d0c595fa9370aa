"""The README's snippets run as they stand."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

from coim import HopperMorph
from coim.experiments.study.definition import PROTOCOLS
from coim.experiments.train import run

README = Path(__file__).parents[1] / "README.md"
SNIPPETS = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)


# The run whose folder a snippet opens.
TINY = dataclasses.replace(PROTOCOLS["smoke"], num_designs=1, imagine="none", threads=1, quiet=True)


def test_there_are_eleven_snippets() -> None:
    assert len(SNIPPETS) == 11


@pytest.mark.parametrize("snippet", SNIPPETS, ids=lambda text: text.splitlines()[-1][:40])
def test_a_snippet_runs(snippet: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in re.findall(r'load_run\("(.*?)"\)', snippet):
        run(HopperMorph, "hopper", dataclasses.replace(TINY, out=Path(folder)))
    before = sorted(tmp_path.rglob("*"))
    exec(compile(snippet, "README.md", "exec"), {})
    assert sorted(tmp_path.rglob("*")) == before, "a snippet left files in the working directory"
