"""Runs whose episodes are native code: what is said where there can be none."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from tiny_runs import run_by_options

from coim.envs.native_episode import library


@pytest.fixture
def nothing_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No native code of this process or of an earlier one."""
    library.cache_clear()
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "cache"))
    yield
    library.cache_clear()


@pytest.mark.parametrize(
    ("script", "sentence"),
    [
        ("exit 1", r"cannot be compiled, leave native episodes out; .*: it ended with 1 \(--no-native-episodes\)$"),
        ("echo no such header >&2; exit 1", r"no such header\s+\(--no-native-episodes\)$"),
        (f"echo '{os.strerror(errno.ENOSPC)}' >&2; exit 1", r"^disk full: [\s\S]* make room there, or --no-native-epi"),
    ],
)
@pytest.mark.usefixtures("nothing_compiled")
def test_where_episodes_cannot_be_compiled_one_sentence_says_so_before_anything_is_written(
    script: str, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler = tmp_path / "compiler"
    compiler.write_text(f"#!/bin/sh\n{script}\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("CXX", str(compiler))
    with pytest.raises(SystemExit, match=sentence):
        run_by_options(tmp_path / "run", "--native-episodes")
    assert not (tmp_path / "run").exists()
