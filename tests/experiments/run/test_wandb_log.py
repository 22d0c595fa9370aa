"""TensorBoard and trackio get every number; Weights & Biases may fail, ask or die; a resumed run goes on in its own."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from interrupted_runs import cut
from tiny_runs import resume, run

from coim import EpisodeDone
from coim.experiments.run.results import Results
from coim.experiments.run.run_log import RunLog, scalars

SMALL = {"num_designs": 2, "episodes": 1}


def children() -> list[int]:
    """W&B's processes of this one."""
    listed = subprocess.run(
        ["ps", "--ppid", str(os.getpid()), "-o", "pid=,args="], capture_output=True, text=True, check=True
    )
    return [int(line.split()[0]) for line in listed.stdout.splitlines() if "wandb-core" in line]


def test_series_have_the_names_of_the_columns() -> None:
    event = EpisodeDone(
        index=0,
        kind="first",
        episode=0,
        design=torch.tensor([[1.0, 1.5], [0.5, 2.0]]),
        training_return=torch.zeros(2),
        evaluation_return=torch.zeros(2),
        env_steps=6,
        imagined=0,
        metrics={},
        seconds={},
    )
    found = scalars(event, ["xi_torso", "xi_foot"])
    assert (found["run 0/xi_foot"], found["run 1/xi_torso"]) == (1.5, 0.5)


def episode(number: int, **changed: Any) -> EpisodeDone:
    return EpisodeDone(
        **{
            "index": 0, "kind": "first", "episode": number, "design": torch.ones(1, 2), "imagined": 0,
            "training_return": torch.zeros(1), "evaluation_return": torch.tensor([float(number)]),
            "env_steps": 10 * (number + 1), "metrics": {}, "seconds": {"search": 2.0}, **changed,
        }
    )  # fmt: skip


def logged(folder: Path, kind: Any) -> None:
    """Two episodes, the second of which has diverged, by the call that every logger has."""
    (folder / "config.json").write_text(json.dumps({"environment": "hopper", "settings": {}}))
    log = RunLog(folder, "hopper", kind, ["torso", "foot"])
    log.write(episode(0))
    log.write(episode(1, diverged={0: (0, 1)}))
    log.close()


def test_tensorboard_has_every_number_over_training_steps(tmp_path: Path) -> None:
    reading = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    logged(tmp_path, "tensorboard")
    found = reading.EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [(point.step, point.value) for point in found.Scalars("seconds/search")] == [(10, 2.0), (20, 2.0)]
    assert [(point.step, point.value) for point in found.Scalars("run 0/return")] == [(10, 0.0), (20, 1.0)]
    assert [(point.step, point.value) for point in found.Scalars("run 0/diverged")] == [(20, 1.0)]


def test_trackio_gets_every_number_of_a_run_that_it_can_resume(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Any] = []
    experiment = SimpleNamespace(
        log=lambda values, step: told.append((values, step)), finish=lambda: told.append("finished")
    )
    begun = SimpleNamespace(init=lambda **options: told.append(options) or experiment)
    monkeypatch.setitem(sys.modules, "trackio", begun)
    monkeypatch.setattr("torchrl.record.loggers.trackio._has_trackio", True)
    logged(tmp_path, "trackio")
    first, *numbers, last = told
    assert (first["project"], first["name"], first["resume"]) == ("coim-hopper", tmp_path.name, "allow")
    assert ({"run 0/return": 0.0}, 10) in numbers
    assert ({"run 0/diverged": 1.0}, 20) in numbers
    assert last == "finished"


@pytest.mark.parametrize(("kind", "name"), [("tensorboard", "TensorBoard"), ("trackio", "trackio")])
def test_a_logger_that_is_not_installed_is_said(
    kind: Any, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = f"torchrl.record.loggers.{kind}"
    monkeypatch.setattr(f"{home}._has_{'tb' if kind == 'tensorboard' else kind}", False)
    with pytest.raises(OSError, match=rf"{name} cannot be started \(.*\); pip install {kind} where it is missing"):
        logged(tmp_path, kind)


def test_a_run_whose_logger_is_not_installed_is_refused_before_it_has_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"--log trackio needs trackio, .*: pip install trackio, or --log off"):
        run(tmp_path / "run", log="trackio")
    assert not (tmp_path / "run").exists()


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_killed_wandb_is_told_and_the_run_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, killed = Results.write, []

    def write_and_kill(results: Results, *args: Any) -> None:
        write(results, *args)
        for pid in children() if len(killed) == 0 and results.notes()["rows"]["evaluations"] == 1 else []:
            os.kill(pid, signal.SIGKILL)
            killed.append(pid)

    monkeypatch.setattr(Results, "write", write_and_kill)
    folder = run(tmp_path / "run", wandb="offline", **SMALL)
    assert killed
    shown = capsys.readouterr().err
    assert shown.count("W&B has failed") == 1
    assert "the run goes on without it" in shown
    with (folder / "designs.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == 2


def test_without_an_account_nobody_is_asked_and_it_goes_offline(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("WANDB_API_KEY", "WANDB_MODE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))  # where an account would be noted
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    folder = run(tmp_path / "run", wandb="online", **SMALL)
    assert "W&B cannot be reached" in capsys.readouterr().err
    assert list(folder.glob("wandb/offline-run-*/*.wandb"))


def test_a_resumed_run_goes_on_in_the_wandb_run_that_it_had(tmp_path: Path) -> None:
    folder = cut(tmp_path / "run", 3, wandb="offline", **SMALL)
    resume(folder)
    own = json.loads((folder / "config.json").read_text())["wandb_id"]
    assert len(own) == 8
    assert {path.stem for path in folder.glob("wandb/offline-run-*/*.wandb")} == {f"run-{own}"}
