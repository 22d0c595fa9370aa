"""A robot that walks in the browser: what is shown is the episode, and the page is served until Ctrl-C."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import mujoco
import numpy as np
import pytest

from coim import run_episode
from coim.envs.camera import PERIOD
from coim.experiments.commands.watch import main
from coim.experiments.drawing.live import Walk
from coim.experiments.export.taken import take
from coim.experiments.pretrained import policy_file

STEPS = 20


def test_what_is_shown_is_the_episode_of_the_policy() -> None:
    taken = take(policy_file("hopper"), "best", run=None, policy=None, body=None)
    walk, alone = Walk(taken), taken.bodies(1, seed=0)
    alone.episode_steps = STEPS
    shown = []
    for _ in range(STEPS):
        walk.step()
        shown.append(walk.figure.data.qpos.copy())
    expected = run_episode(alone, taken.policy, design=taken.design[None], deterministic=True)["next", "observation"]
    joints = len(walk.figure.data.qpos) - 1  # without the place on the ground
    np.testing.assert_allclose([pose[1:] for pose in shown], expected[:, 0, :joints], atol=1e-6)
    assert walk.figure.model.opt.timestep == alone.step_seconds
    assert all(0 <= pose[0] < PERIOD for pose in shown)
    walk.reset()
    assert np.abs(walk.figure.data.qpos - shown[-1]).max() > 0.02
    np.testing.assert_allclose(walk.figure.data.qpos[1:], shown[0][1:], atol=0.02)  # as it stood before


def test_forces_that_are_shown_are_those_of_the_walk() -> None:
    walk = Walk(take(policy_file("hopper"), "best", run=None, policy=None, body=None))
    while not walk.figure.data.ncon:
        walk.step()
    simulations = walk._bodies.simulations
    model = simulations.model(0)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = simulations.qpos[0], simulations.qvel[0], simulations.ctrl[0]
    mujoco.mj_forward(model, data)
    assert np.abs(data.qfrc_constraint).max() > 100
    np.testing.assert_allclose(walk.figure.data.qfrc_constraint, data.qfrc_constraint, rtol=1e-4, atol=1e-2)


def test_the_page_is_served_until_it_is_told_to_end(tmp_path: Path) -> None:
    pytest.importorskip("mjviser")
    program = "from coim.experiments.command import main; main()"
    words = ["watch", "--pretrained", "hopper", "--live", "--port", "18431"]
    with subprocess.Popen(
        [sys.executable, "-u", "-c", program, *words],
        cwd=tmp_path,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        text=True,
    ) as served:
        assert served.stdout is not None
        line = next(line for line in served.stdout if "http://" in line)
        page = next(word for word in line.split() if word.startswith("http://"))
        with urllib.request.urlopen(page, timeout=20) as answer:
            assert b"<html" in answer.read().lower()
        time.sleep(0.5)
        served.send_signal(signal.SIGINT)
        assert served.wait(20) == 0
    assert not [*tmp_path.iterdir()]


def test_what_is_of_a_film_is_refused(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit, match="--steps, --width is of a film: leave it out with --live"):
        main(["--pretrained", "hopper", "--live", "--steps", "9", "--width", "64"])


def test_a_port_is_of_the_page_alone() -> None:
    with pytest.raises(SystemExit, match="--port is of --live, leave it out without"):
        main(["--pretrained", "hopper", "--port", "9"])


def test_without_mjviser_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mjviser", None)
    with pytest.raises(SystemExit, match=r"--live shows a robot by mjviser .*; pip install 'coim\[live\]'"):
        main(["--pretrained", "hopper", "--live"])
