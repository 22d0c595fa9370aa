"""Weights & Biases fails, asks or dies, and the run goes on; a resumed run goes on in the W&B run that it had."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest
import torch
from interrupted_runs import cut
from tiny_runs import resume, run

from coim import EpisodeDone
from coim.experiments.run.results import Results
from coim.experiments.run.wandb_log import scalars

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
