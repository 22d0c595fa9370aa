"""A wheel built from the checkout works by itself: in an environment and a folder outside of it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Callable
from pathlib import Path

import pytest

from coim.experiments.pretrained import names

ROOT = Path(__file__).parents[2]
SOURCES = ("coim", "setup.cfg", "pyproject.toml", "README.md", "LICENSE")
RUN = ["--preset", "quick", "--num-designs", "1", "--first-episodes", "1", "--episode-steps", "20", "--threads", "1"]
RUN += ["--individual-updates", "1", "--population-updates", "1", "--model-updates", "1"]
STUDY = """{"name": "mine", "environments": ["hopper"], "arms": ["none"], "seeds": [0], "protocol": "smoke",
"overrides": {"num_designs": 1}}"""

Coim = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def coim(tmp_path_factory: pytest.TempPathFactory) -> Coim:
    """The command of an environment that has the wheel; what coim needs is borrowed from this environment."""
    checkout, wheels, home = (tmp_path_factory.mktemp(name) for name in ("checkout", "wheels", "elsewhere"))
    for name in SOURCES:
        source = ROOT / name
        copy = shutil.copytree if source.is_dir() else shutil.copy
        copy(source, checkout / name)
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(wheels), str(checkout)]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = wheels.iterdir()
    shutil.rmtree(checkout)
    venv.create(home / "venv", symlinks=True)
    library = Path(sysconfig.get_path("purelib", vars={"base": str(home / "venv")}))
    install = ["--python", str(home / "venv/bin/python"), "install", "--no-deps", str(wheel)]
    subprocess.run([*pip, *install], check=True, capture_output=True)
    # Behind the wheel in the path, so that this checkout, which is installed here for development, is not found first.
    (library / "borrowed.pth").write_text(sysconfig.get_path("purelib"))

    def call(*words: str) -> subprocess.CompletedProcess[str]:
        clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        command = [home / "venv/bin/coim", *words]
        return subprocess.run(command, cwd=home, env=clean, capture_output=True, text=True, check=False)

    return call


def test_the_command_lists_its_words_and_refuses_others(coim: Coim) -> None:
    listed = coim()
    assert listed.returncode == 0
    assert "coim WORD --help" in listed.stdout
    unknown = coim("runn")
    assert (unknown.returncode, unknown.stdout) == (2, "")
    assert "there is no 'runn'; it must be one of run, resume, study" in unknown.stderr


def test_the_trained_robots_come_with_it(coim: Coim) -> None:
    there = coim("watch", "--pretrained", "ostrich")
    assert (there.returncode, there.stdout) == (1, "")
    assert "--pretrained is 'ostrich': there are" in there.stderr
    assert all(name in there.stderr for name in names())


def test_a_run_is_made_resumed_and_reported_from_another_folder(coim: Coim) -> None:
    made = coim("run", "hopper", *RUN, "--out", "mine")
    assert (made.returncode, made.stderr) == (0, "")
    assert "to film it: coim watch mine --design 1" in made.stdout
    longer = coim("resume", "mine", "--num-designs", "2", "--quiet")
    assert longer.returncode == 0, longer.stderr
    page = coim("report", "mine")
    assert (page.returncode, page.stdout.strip()) == (0, "mine/report.html")


def test_a_study_is_computed_from_another_folder(coim: Coim, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    (tmp_path / "mine.json").write_text(STUDY)
    computed = coim("study", str(tmp_path / "mine.json"), "--out", str(tmp_path / "study"), "--workers", "1")
    assert computed.returncode == 0, computed.stderr
    assert (tmp_path / "study/cells/hopper-forward-none-0/report.html").exists()
