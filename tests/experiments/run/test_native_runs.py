"""Runs whose episodes are native code: what is said where there can be none."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from tiny_runs import run_by_options

from coim.envs.native_episode import library
from coim.experiments.run.machine import check_compiler


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--compile"], "native gradients,"),
        (["--compile", "--num-cells", "257"], "native gradients of the model,"),
        (["--compile", "--model-cells", "513"], "native gradients of policy and critics,"),
        (["--compile", "--num-cells", "257", "--imagine", "none"], "not compiled,"),
        (["--compile", "--num-cells", "257", "--dream", "simulator"], "not compiled,"),
        ([], "not compiled,"),
    ],
)
@pytest.mark.usefixtures("undrawn")
def test_a_run_says_which_gradients_are_native(
    options: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_by_options(tmp_path / "run", "--no-quiet", *options)
    first = capsys.readouterr().out.splitlines()[0]
    assert f" thread, {said} " in first or f" each, {said} " in first


def test_code_that_an_earlier_process_made_serves_from_a_folder_that_cannot_be_written_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_by_options(tmp_path / "first", "--compile", "--native-episodes")
    monkeypatch.setattr("coim.experiments.run.machine.os.access", lambda path, mode: mode != os.W_OK)
    with pytest.raises(ValueError, match="cannot be written to; name another folder by the environment variable TORCH"):
        check_compiler()
    run_by_options(tmp_path / "second", "--compile", "--native-episodes")
    assert (tmp_path / "second" / "designs.csv").exists()


def test_where_nothing_is_compiled_no_compiler_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    run_by_options(tmp_path / "run", "--compile", "--num-cells", "257", "--imagine", "none")
    with pytest.raises(
        SystemExit, match=r"no C\+\+ compiler \(no-such-compiler\) was found; install one, or --no-compile"
    ):
        run_by_options(tmp_path / "other", "--compile", "--num-cells", "257")  # whose model is narrow


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
