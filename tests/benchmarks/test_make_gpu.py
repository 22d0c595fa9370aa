"""`make gpu` without a GPU: it says what is missing, and its whole way can be rehearsed on a CPU."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from benchmarks import gpu, warp
from benchmarks.gpu import Options, main

ROWS = {f"{row}, K = {runs}" for row in ("update", "small update", "iteration") for runs in (1, 2)}
PHYSICS = {f"physics, {name}, K = 2" for name in ("half_cheetah", "walker", "hopper", "ant")}


def test_the_whole_way_can_be_rehearsed_without_a_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu, "marked_tests", lambda seconds: {"holds": True, "tests": 0})
    monkeypatch.setattr(gpu, "lacks_warp", lambda: "not installed")  # on a CPU its kernels take a minute to compile
    main(Options(rehearse=True, out=tmp_path / "runs" / "gpu.json"))
    found = json.loads((tmp_path / "runs" / "gpu.json").read_text())
    assert found["rehearsal"]
    assert found["parts"].keys() == {"tests", "fleet"} | ROWS | PHYSICS
    assert all(found["parts"][name]["left out"] == "not installed" for name in PHYSICS)
    assert found["parts"]["fleet"]["largest difference of an observation"] == 0  # of the CPU from the CPU
    assert found["parts"]["fleet"]["designs"] == 3
    assert all(figure["ratio"]["median"] > 0 for name in ROWS for figure in found["parts"][name]["figures"])


def test_a_fleet_is_compared_with_that_of_the_host(monkeypatch: pytest.MonkeyPatch) -> None:
    made = warp._fleet
    monkeypatch.setattr(warp, "_fleet", lambda name, bodies, **how: made(name, bodies))  # MuJoCo on both sides
    (figure,) = warp.physics("hopper", 2, gpu.TINY, torch.device("cpu"))
    assert figure.ratio > 0
    assert figure.note.endswith("largest): 0, 0, 0")


def test_what_cannot_be_compiled_is_told_beside_what_was_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_compiler(*_: object, **__: object) -> None:
        raise RuntimeError("no compiler")

    monkeypatch.setattr("coim.learners.sac.NativeSAC", no_compiler)
    found = gpu.update(gpu.TINY, 2, torch.device("cpu"))
    assert found["failed"] == {"float32, compiled": "RuntimeError: no compiler"}
    assert not found["holds"]
    assert [figure["row"] for figure in found["figures"]] == ["update, K = 2, float32", "update, K = 2, bfloat16"]


def test_marked_tests_are_counted() -> None:
    counted = gpu.marked_tests(120)
    assert counted["holds"], counted
    assert counted["tests"] >= 5
    if not torch.cuda.is_available():
        assert counted["skipped"] == counted["tests"]


def test_a_part_that_fails_or_comes_too_late_is_told_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def broken(*_: object) -> gpu.Result:
        raise RuntimeError("no kernel image")

    for name in ("marked_tests", "fleet", "update", "iteration", "stepped"):
        monkeypatch.setattr(gpu, name, broken if name == "fleet" else lambda *_: {"holds": True})
    out = tmp_path / "gpu.json"
    with pytest.raises(SystemExit, match="not well: fleet; see"):
        main(Options(rehearse=True, out=out))
    assert json.loads(out.read_text())["parts"]["fleet"]["error"] == "RuntimeError: no kernel image"
    with pytest.raises(SystemExit, match="not well: tests; fleet; update, K = 1"):
        main(Options(rehearse=True, out=out, minutes=0))
    assert "left out after 0 min" in capsys.readouterr().out


@pytest.mark.skipif(torch.cuda.is_available(), reason="nothing is missing where there is a GPU")
def test_one_line_says_what_is_missing(tmp_path: Path) -> None:
    script = Path(gpu.__file__).with_name("missing.py")
    ended = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert ended.stderr.startswith("make gpu needs a GPU of NVIDIA, and torch ")
    assert ended.stderr.count("\n") == 1
    with pytest.raises(SystemExit, match="make gpu needs a GPU"):
        main(Options(out=tmp_path / "gpu.json"))
    assert not (tmp_path / "gpu.json").exists()
