"""Every command ends at Ctrl-C with one line and the code that shells know, also while it is still importing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from coim.experiments.command import COMMANDS as WORDS
from coim.experiments.commands import figures
from coim.experiments.run.interrupt import on_command_line, stopping_at_once

ROOT = Path(__file__).parents[3]
COMMANDS = [["coim.experiments", word, "hopper"] for word in WORDS]
# Scripts to copy are as short as they can be; Python's own traceback is good enough there.
TO_COPY = {"algorithm1.py", "new_body.py", "new_search.py", "own_pipeline.py"}
COMMANDS += sorted(
    [".".join(path.relative_to(ROOT).with_suffix("").parts)]
    for package in ("recipes", "benchmarks")
    for path in (ROOT / package).rglob("*.py")
    if '__name__ == "__main__"' in path.read_text() and path.name not in TO_COPY
)


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Put the signal handlers back that somebody who was told to end leaves to the end of the process."""
    before = {signum: signal.getsignal(signum) for signum in (signal.SIGINT, signal.SIGTERM)}
    yield
    for signum, handler in before.items():
        signal.signal(signum, handler)


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_ctrl_c_during_imports_is_one_line(command: list[str], tmp_path: Path) -> None:
    """Also where a library catches whatever happens while it is imported."""
    stopped = "import signal\ntry:\n    signal.raise_signal(signal.SIGINT)\nexcept BaseException:\n    pass\n"
    for slow in ("torch", "tyro", "matplotlib", "ray"):  # Ctrl-C comes in the middle of the first of them
        (tmp_path / f"{slow}.py").write_text(stopped)
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    ended = subprocess.run(
        [sys.executable, "-m", *command],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.stderr.strip() == "stopped by Ctrl-C"
    assert ended.returncode == 128 + signal.SIGINT


def test_ctrl_c_in_a_command_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(figures, "write_figures", lambda study, out: signal.raise_signal(signal.SIGINT))
    with pytest.raises(SystemExit) as ended:
        figures.main([str(tmp_path)])
    assert ended.value.code == 130
    assert capsys.readouterr().err.strip() == "stopped by Ctrl-C"


def test_an_error_that_a_stop_has_caused_is_no_error_of_the_input(capsys: pytest.CaptureFixture) -> None:
    """Ctrl-C reaches every process of a terminal: that which writes a film is gone before its next picture."""

    def write() -> None:
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            raise BrokenPipeError("the encoder is gone")

    with pytest.raises(SystemExit) as ended, on_command_line(own_process=False, again="the same command goes on"):
        write()
    assert ended.value.code == 143
    assert capsys.readouterr().err.strip() == "stopped by SIGTERM; the same command goes on"


def test_errors_are_a_line_if_they_are_expected() -> None:
    with pytest.raises(SystemExit, match=r"^no such folder$"), on_command_line(own_process=False):
        raise OSError("no such folder")
    with (
        pytest.raises(SystemExit, match=r"^no OpenGL$"),
        on_command_line(own_process=False, also=(ImportError,)),
    ):
        raise ImportError("no OpenGL")
    with pytest.raises(ImportError, match="no OpenGL"), on_command_line(own_process=False):
        raise ImportError("no OpenGL")


def test_a_thread_beside_the_main_one_can_run_a_command() -> None:
    def work() -> str:
        with stopping_at_once():
            return "done"

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(work).result() == "done"
