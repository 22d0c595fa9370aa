"""Studies and retrainings on a real Ray of this machine: a cluster whose head computes nothing, and one for a command.

All of them are here, so that one process starts Ray where several share the tests.
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_runs import OPTIONS, run_by_options, without_page

from benchmarks.soak import differences
from coim import HopperMorph
from coim.experiments.commands.retrain import main as retrain
from coim.experiments.commands.study import main as entry
from coim.experiments.figures.write import write_figures
from coim.experiments.study import cluster as cluster_module
from coim.experiments.study.cluster import (
    LONGEST,
    SOCKET,
    SOCKETS,
    short_folder,
    token_without_file,
    without_words_of_ray,
)
from coim.experiments.study.definition import Block, Study, to_json
from coim.experiments.study.ledger import Ledger, read_ledger
from coim.experiments.study.ray_scheduler import Conductor, Resources, lacking
from coim.experiments.train import run as run_recipe
from coim.tables import design_columns

pytest.importorskip("ray.cluster_utils")
XI = design_columns(HopperMorph.design_names())
SLOWER = {"num_designs": 7, "individual_updates": 150}  # an episode takes long enough to be hit


def study(**fields: object) -> Study:
    least = {"name": "test", "environments": ("hopper",), "arms": ("none",), "seeds": (0,), "protocol": "smoke"}
    return Study(**{**least, **fields})


def conduct(folder: Path, what: Study) -> tuple[list[str], Ledger]:
    """Compute a study on the cluster that there is."""
    folder.mkdir(exist_ok=True)
    cells = what.cells()
    ledger = Ledger(folder / "ledger.csv", cells)
    with without_words_of_ray(folder) as terminal:
        return Conductor(folder, cells, ledger, Resources(), terminal).conduct(), ledger


def meanwhile(folder: Path, cell: str, *, rows: int, act: Callable[[int], None]) -> threading.Thread:
    """When a cell has so many episodes, do something with the process that computes it."""

    def watch() -> None:
        table, log = folder / "cells" / cell / "evaluations.csv", folder / "logs" / f"{cell}.log"
        while not table.exists() or table.read_text().count("\n") <= rows:
            time.sleep(0.01)
        act(int(log.read_text().splitlines()[0].split()[-1]))

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    return thread


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.usefixtures("cluster")
def test_every_cell_of_a_study_is_an_ordinary_run_and_pairs_share_their_first_designs(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    failed, ledger = conduct(tmp_path, study(arms=("none", "oracle")))
    assert failed == []
    assert [(row.state, row.tries, row.message) for row in read_ledger(tmp_path / "ledger.csv")] == [
        ("finished", 1, "")
    ] * 2
    none, oracle = (tmp_path / "cells" / name for name in ledger.entries)
    designs = [read(folder / "designs.csv") for folder in (none, oracle)]
    assert [[row["kind"] for row in rows] for rows in designs] == [["first"] * 5 + ["optimised"]] * 2
    assert all(a[name] == b[name] for a, b in list(zip(*designs))[:5] for name in XI)
    assert read(none / "evaluations.csv")[0]["return"] == read(oracle / "evaluations.csv")[0]["return"]
    assert (none / "report.html").exists()
    waiting, *lines = capsys.readouterr().out.splitlines()
    assert waiting.startswith("2 cell(s) wait for their processes")
    assert sorted(line.split()[2] for line in lines) == ["finished", "finished", "started", "started"]
    assert lines[-1].endswith("2 of 2")
    assert conduct(tmp_path, study(arms=("none", "oracle")))[0] == []  # nothing is left to do
    assert capsys.readouterr().out == ""


@pytest.mark.usefixtures("cluster")
def test_a_cell_whose_process_is_killed_goes_on_from_its_checkpoint_to_the_same_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    what, cell = study(arms=("known",), overrides=SLOWER), "hopper-forward-known-0"
    peace = tmp_path / "peace" / "cells" / cell
    with without_page():
        run_recipe(HopperMorph, "hopper", dataclasses.replace(what.cells()[0].settings, out=peace, threads=1))
    killing = meanwhile(tmp_path / "killed", cell, rows=3, act=lambda pid: os.kill(pid, signal.SIGKILL))
    failed, ledger = conduct(tmp_path / "killed", what)
    killing.join()
    assert failed == []
    assert (ledger.entries[cell].state, ledger.entries[cell].tries) == ("finished", 2)
    assert differences(peace, tmp_path / "killed" / "cells" / cell) == []
    out, err = capsys.readouterr()
    assert [line.split(maxsplit=2)[2].split(" in ")[0] for line in out.splitlines()[1:]] == [
        "started",
        "goes on (try 2)",
        "finished",
    ]
    assert err == ""


def test_a_cell_whose_node_dies_goes_on_on_another(cluster: Any, tmp_path: Path) -> None:
    what, cell = study(overrides=SLOWER), "hopper-forward-none-0"
    cluster.add_node(num_cpus=2)

    def lose_its_node(pid: int) -> None:
        parent = Path(f"/proc/{pid}/stat").read_text().split()[3]  # what Ray starts on each node
        for process in (int(parent), pid):
            os.kill(process, signal.SIGKILL)

    losing = meanwhile(tmp_path, cell, rows=2, act=lose_its_node)
    failed, ledger = conduct(tmp_path, what)
    losing.join()
    assert failed == []
    assert ledger.entries[cell].tries == 2
    assert len(read(tmp_path / "cells" / cell / "evaluations.csv")) == 7


@pytest.mark.usefixtures("cluster")
def test_a_cell_that_fails_is_tried_again_twice_and_the_others_are_computed(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    (tmp_path / "cells").mkdir()
    (tmp_path / "cells" / "hopper-forward-known-0").write_text("in the way")
    what = study(arms=("known", "none"))
    failed, ledger = conduct(tmp_path, what)
    assert failed == ["hopper-forward-known-0"]
    bad, good = ledger.entries.values()
    assert (bad.state, bad.tries, good.state, good.tries) == ("failed", 3, "finished", 1)
    assert "hopper-forward-known-0" in bad.message
    assert bad.message
    assert not re.match(r"\w*Error", bad.message)
    assert (tmp_path / "logs" / "hopper-forward-known-0.log").read_text().count("Traceback") >= 3
    assert "failed: " in capsys.readouterr().out
    (tmp_path / "cells" / "hopper-forward-known-0").unlink()
    assert conduct(tmp_path, what)[0] == []
    assert [(row.state, row.message) for row in read_ledger(tmp_path / "ledger.csv")] == [("finished", "")] * 2


@pytest.mark.usefixtures("cluster")
def test_a_study_that_is_told_to_end_stops_at_once_and_goes_on_by_the_line_it_prints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    brief = Block(environments=("hopper",), arms=("known",), seeds=(0,), overrides={"num_designs": 1})
    what, cells = study(overrides=SLOWER, blocks=(brief,)), ["hopper-forward-none-0", "hopper-forward-known-0"]
    (tmp_path / "my.json").write_text(to_json(what))
    folder = tmp_path / "my study"
    arguments = [str(tmp_path / "my.json"), "--out", str(folder), "--workers", "1"]
    temporary = {"TMPDIR": tempfile.mkdtemp(dir="/tmp")}
    nowhere = {"HOME": "/proc", "MPLCONFIGDIR": str(tmp_path)}  # nothing can be written at home
    begun = time.monotonic()
    first = subprocess.Popen(
        [sys.executable, "-m", "coim.experiments", "study", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | temporary | nowhere | {"RAY_worker_niceness": "0"},
    )

    def refuse_another_and_stop(pid: int) -> None:
        with pytest.raises(SystemExit, match=f"is in use by process {first.pid} "):
            entry(arguments)
        stopped.append((pid, time.monotonic()))
        first.send_signal(signal.SIGTERM)

    stopped: list[tuple[int, float]] = []
    meanwhile(folder, cells[0], rows=3, act=refuse_another_and_stop)
    out, err = first.communicate(timeout=100)
    ((pid, at),) = stopped
    assert time.monotonic() - at < at - begun  # sooner than it got under way, however slow the machine is
    assert first.returncode == 128 + signal.SIGTERM
    assert not Path(f"/proc/{pid}").exists()
    assert out.splitlines()[0] == f"test: 2 of 2 cells to compute -> {folder}"
    assert out.splitlines()[1].startswith("starting Ray on this machine")
    assert out.splitlines()[2].startswith("2 cell(s) wait for their processes")
    assert [line.split(maxsplit=1)[1] for line in out.splitlines()[3:]] == [f"{cells[0]}  started"]
    assert [(row.state, row.tries) for row in read_ledger(folder / "ledger.csv")] == [("waiting", 1), ("waiting", 0)]
    told = shlex.split(err.strip())
    assert told[:6] == ["stopped", "by", "SIGTERM;", "to", "go", "on:"]
    assert told[6:] == ["coim", "study", *arguments]
    assert list(Path(temporary["TMPDIR"]).iterdir()) == []
    monkeypatch.setattr(
        "coim.experiments.commands.study.ray_running", lambda *_, **__: contextlib.nullcontext()
    )  # on the cluster there is
    entry(told[8:])
    assert [(row.state, row.tries) for row in read_ledger(folder / "ledger.csv")] == [("finished", 2), ("finished", 1)]
    assert [len(read(folder / "cells" / cell / "evaluations.csv")) for cell in cells] == [7, 1]


@pytest.mark.usefixtures("cluster", "undrawn")
def test_designs_are_retrained_once_and_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "coim.experiments.commands.retrain.ray_running", lambda *_, **__: contextlib.nullcontext()
    )  # on the cluster there is
    for arm in ("none", "known"):
        run_by_options(tmp_path / "cells" / f"hopper-forward-{arm}-0", "--imagine", arm, "--quiet")
    with pytest.raises(SystemExit, match=r"no node has 1 cores and 0.5 of a GPU here; ask for less"):
        retrain([str(tmp_path), "--episodes", "2", "--gpus", "0.5"])
    capsys.readouterr()
    retrain([str(tmp_path), "--episodes", "2", "--workers", "1"])
    said = capsys.readouterr().out
    assert "2 of 2 designs to train" in said
    assert "\n2 training episodes on each\n" in said
    chosen = read(tmp_path / "retrained" / "designs.csv")
    for line in chosen:
        cell = tmp_path / "cells" / line["cell"]
        found = next(row for row in read(cell / "designs.csv") if row["kind"] == "optimised")
        episodes = read(tmp_path / "retrained" / "cells" / line["folder"] / "evaluations.csv")
        assert [row["kind"] for row in episodes] == ["first", "first"]
        assert [row["episode"] for row in episodes] == ["1", "2"]
        assert all(row[name] == found[name] for row in episodes for name in XI)
    retrain([str(tmp_path), "--episodes", "2", "--workers", "1"])
    assert "0 of 2 designs to train" in capsys.readouterr().out
    with pytest.raises(SystemExit, match=r"made with other settings: first_episodes \(2 to 3\)"):
        retrain([str(tmp_path), "--episodes", "3"])
    write_figures(tmp_path)
    rows = read(tmp_path / "figures" / "figure_2_retrained.csv")
    for row, line in zip(rows, chosen, strict=True):
        own = read(tmp_path / "retrained" / "cells" / line["folder"] / "evaluations.csv")
        assert float(row["best_return"]) == max(float(episode["return"]) for episode in own)
        assert (row["episodes"], row["study_episodes"]) == ("2", OPTIONS[OPTIONS.index("--episodes") + 1])


def test_paths_of_sockets_are_short_enough_everywhere(cluster: Any) -> None:
    node = cluster.head_node
    added = len(node.plasma_store_socket_name) - len(node.get_temp_dir_path())
    assert added + len("/ray-12345678") <= SOCKETS
    assert LONGEST + SOCKETS <= SOCKET


def test_a_long_folder_for_temporary_files_is_passed_over(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(tempfile, "tempdir", "/tmp")
    assert short_folder() == "/tmp"
    job = tmp_path / ("x" * LONGEST)
    job.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(job))
    assert short_folder() == "/tmp"
    monkeypatch.setattr(cluster_module, "SHORT", ("/tmp/" + "y" * LONGEST, "/nowhere"))
    with pytest.raises(OSError, match=rf"at most {LONGEST} bytes; TMPDIR is {job}, .* set TMPDIR to a shorter one"):
        short_folder()


def test_a_token_is_in_the_environment_while_it_is_needed_and_one_that_was_set_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"):
        monkeypatch.delenv(name, raising=False)
    with token_without_file():
        assert len(os.environ["RAY_AUTH_TOKEN"]) == 64
    assert "RAY_AUTH_TOKEN" not in os.environ
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", "/mine")
    with token_without_file():
        assert "RAY_AUTH_TOKEN" not in os.environ


def test_cells_that_failed_are_listed_and_the_exit_code_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def fail(conductor: Conductor) -> list[str]:
        conductor.ledger.note("hopper-forward-known-0", "failed", message="no luck")
        return ["hopper-forward-known-0"]

    monkeypatch.setattr("coim.experiments.commands.study.ray_running", lambda *_, **__: contextlib.nullcontext())
    monkeypatch.setattr("coim.experiments.study.ray_scheduler.lacking", lambda _: "")
    monkeypatch.setattr(Conductor, "conduct", fail)
    with pytest.raises(SystemExit) as ended:
        entry(["smoke", "--out", str(tmp_path / "s")])
    assert ended.value.code == (
        "failed, after 3 tries each:\n  hopper-forward-known-0: no luck\n"
        f"to try them again: coim study smoke --out {tmp_path / 's'}"
    )
    assert capsys.readouterr().out == f"smoke: 2 of 2 cells to compute -> {tmp_path / 's'}\n"


@pytest.mark.usefixtures("cluster")
def test_what_no_node_has_is_said_instead_of_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coim.experiments.commands.study.ray_running", lambda *_, **__: contextlib.nullcontext())
    monkeypatch.setattr("coim.experiments.commands.study.checked_device", torch.device)  # as if this machine had a GPU
    with pytest.raises(SystemExit, match=r"no node has 1 cores and 0.5 of a GPU here; ask for less"):
        entry(["smoke", "--out", str(tmp_path / "s"), "--gpus", "0.5"])
    assert lacking(Resources(cpus=2)) == ""
    assert lacking(Resources(cpus=3)) == "no node has 3 cores"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["previw"], "'previw' is no study: there are paper, preview, bodies-develop, bodies, "),
        (["smoke", "--cpus", "0"], "--cpus is 0, a cell needs at least 1"),
        (["smoke", "--gpus", "-1"], "--gpus is -1"),
        (["smoke", "--workers", "-1"], "--workers is -1"),
        (["smoke", "--gpus", "nan"], "--gpus is nan"),
        (["smoke", "--cpus", "1000"], r"--workers x --cpus is 1 x 1000, this machine has \d+ core"),
        (["smoke", "--workers", "2", "--ray-address", "auto"], "a cluster decides itself"),
    ],
)
def test_what_cannot_be_asked_for_is_named(arguments: list[str], sentence: str) -> None:
    with pytest.raises(SystemExit, match=sentence):
        entry(arguments)
