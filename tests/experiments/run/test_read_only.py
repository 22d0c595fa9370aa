"""A folder that cannot be written to, from the start or from some moment on: one sentence, and nothing is lost."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from tiny_runs import resume, run

from benchmarks import soak
from coim import HopperMorph
from coim.experiments.run.checkpoint import Checkpoints
from coim.experiments.run.results import Results
from coim.experiments.train import main

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="capabilities are Linux's")


@contextmanager
def stopped_by_permissions() -> Iterator[None]:
    """Root, as whom containers run tests, may write anywhere: put that right of its down for a while."""
    libc, header = ctypes.CDLL(None), (ctypes.c_uint32 * 2)(0x20080522, 0)
    before = (ctypes.c_uint32 * 6)()
    assert libc.capget(header, before) == 0
    without = (ctypes.c_uint32 * 6)(*before)
    without[0] &= ~0b110  # CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH among the effective ones
    assert libc.capset(header, without) == 0
    try:
        yield
    finally:
        assert libc.capset(header, before) == 0


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """A folder of somebody whom permissions stop."""
    with stopped_by_permissions():
        yield tmp_path
    for path in [tmp_path, *tmp_path.rglob("*/")]:
        path.chmod(0o700)


def test_an_out_that_cannot_be_made_is_one_sentence(folder: Path) -> None:
    folder.chmod(0o500)
    with pytest.raises(SystemExit) as stop:
        main(HopperMorph, "hopper", ["--preset", "quick", "--out", str(folder / "run")])
    said = str(stop.value.code)
    assert f"{folder / 'run'} cannot be written to (Permission denied)" in said
    assert "name another folder for a new run with --out" in said
    assert "\n" not in said


@pytest.mark.parametrize(("owner", "method"), [(Checkpoints, "save"), (Results, "write")])
def test_a_folder_that_becomes_read_only_stops_the_run_with_a_good_checkpoint(
    folder: Path, monkeypatch: pytest.MonkeyPatch, owner: type, method: str
) -> None:
    whole = run(folder / "whole")
    victim, original, calls = folder / "run", getattr(owner, method), 0

    def lock_and_write(*args: Any) -> None:
        nonlocal calls
        calls += 1
        if calls == 5:
            for path in (victim / "evaluations.csv", victim / "checkpoint" / "replay.bin"):
                path.chmod(0o400)
            for path in (victim, victim / "checkpoint"):
                path.chmod(0o500)
        original(*args)

    with monkeypatch.context() as patched:
        patched.setattr(owner, method, lock_and_write)
        with pytest.raises(OSError, match="Permission denied") as stop:
            run(victim)
    said = str(stop.value)
    assert f"make {victim} writable; to go on: coim resume {victim}" in said
    assert "\n" not in said
    with pytest.raises(SystemExit, match="Permission denied"):
        resume(victim)
    for path in (victim, victim / "checkpoint", victim / "evaluations.csv", victim / "checkpoint" / "replay.bin"):
        path.chmod(0o700)
    resume(victim)
    assert soak.differences(whole, victim) == []
