"""The soak recipe on a toy scale: what it writes, and that it sees what differs."""

from __future__ import annotations

import csv
import signal
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch

from benchmarks import soak
from benchmarks.learning_curve import Curve
from benchmarks.train_networks import Training
from coim.experiments.run.settings import Settings


def test_every_kill_has_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    made: list[Settings] = []

    def killed_and_resumed(folder: Path, settings: Settings, moment: float) -> int:
        assert 0 < moment < 9.0
        made.append(settings)
        return 4

    monkeypatch.setattr(soak, "left_alone", lambda folder, settings: 9.0)
    monkeypatch.setattr(soak, "killed_and_resumed", killed_and_resumed)
    monkeypatch.setattr(soak, "differences", lambda one, other: ["replay.bin"] if other.name == "2" else [])
    soak.main(soak.Soak(kills=5, out=tmp_path / "soak.csv"))
    with (tmp_path / "soak.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["identical"] for row in rows] == ["True", "True", "False", "True", "True"]
    assert [row["kind"] for row in rows] == ["known designs", "fleet", "baseline", "compiled", "known designs"]
    assert made == [*soak.KINDS.values(), soak.SMALL]
    assert "4 of 5 identical" in capsys.readouterr().out


def test_no_command_writes_over_the_results_that_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(soak, "left_alone", lambda folder, settings: 9.0)
    for _ in range(2):
        soak.main(soak.Soak(kills=0))
    assert len(list((tmp_path / "runs").glob("soak-*.csv"))) == 2
    assert "known designs: a run in peace" in capsys.readouterr().out
    for out in (Curve().out, Training().out):
        assert out.parent == Path("runs")


def test_a_soak_that_is_told_to_end_takes_its_run_with_it() -> None:
    process = Mock(join=Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        soak.finish(process)
    process.kill.assert_called_once_with()


def test_ctrl_c_is_kept_from_the_process_that_imports_for_all_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONWARNINGS", "error")
    kept_from: list[bool] = []
    for name in ("forkserver.ensure_running", "PLAIN.Process"):
        monkeypatch.setattr(f"benchmarks.soak.{name}", lambda *args, **kwargs: kept_from.append(blocked()) or Mock())

    def blocked() -> bool:
        return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())

    soak.start(tmp_path, soak.SMALL)
    assert kept_from == [True, False]


def test_what_differs_is_named() -> None:
    one = {"a": torch.zeros(2), "b": (1, None), "c": {"d": 0.5}}
    other = {"a": torch.tensor([0.0, 1e-30]), "b": (1, 2), "c": {"d": 0.5}}
    assert list(soak.unequal(one, one, path="state")) == []
    assert list(soak.unequal(one, other, path="state")) == ["state.a", "state.b.1"]
    assert list(soak.unequal(one, {"a": one["a"]}, path="state")) == ["state"]
