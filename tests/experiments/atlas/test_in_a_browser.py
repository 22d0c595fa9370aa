"""The atlas in headless Chromium: the robot moves, no script fails, and bodies and actions are those of Python.

The simulator is not in the repository: ``COIM_MUJOCO_WASM=mujoco-mujoco-3.14.0.tgz`` names its npm package.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tiny_runs import run

from coim import load_run, morph_from_mjcf
from coim.envs import AntMorph, HalfCheetahMorph, HopperMorph, MorphEnv, WalkerMorph
from coim.envs.camera import drawn_axes
from coim.experiments.atlas.walkers import body_table
from coim.experiments.commands.atlas import main
from coim.experiments.drawing.bodies import seen

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed: it drives the browser")
BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
PACKAGE = os.environ.get("COIM_MUJOCO_WASM")
FLAGS = ("headless", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run", "disable-background-networking")
FLAGS += ("disable-component-update", "disable-sync")
STEPS = 4  # the next one drives the ant into the floor, which makes much of rounding
SECONDS = 60.0  # to wait for a page on a busy machine

pytestmark = pytest.mark.skipif(
    None in (BROWSER, DRIVER), reason="no chromium and chromedriver here (Debian: apt-get install chromium-driver)"
)
simulated = pytest.mark.skipif(PACKAGE is None, reason="COIM_MUJOCO_WASM names no npm package @mujoco/mujoco")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(tmp_path_factory.mktemp("atlas") / "run", num_designs=4, imagine="none", episode_steps=60)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    options = webdriver.ChromeOptions()
    options.binary_location = BROWSER
    for flag in (*FLAGS, f"user-data-dir={tmp_path_factory.mktemp('chromium')}"):
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    yield driver
    driver.quit()


def until(browser: Any, script: str) -> Any:
    """Wait until an expression of the page is true."""
    end = time.monotonic() + SECONDS
    while not (found := browser.execute_script(f"return {script}")):
        assert time.monotonic() < end, f"{script} has not become true in {SECONDS} s"
        time.sleep(0.05)
    return found


def move_slider(browser: Any, entry: int, value: float) -> None:
    browser.execute_script(
        "const slider = document.getElementById(`slider-${arguments[0]}`); slider.value = arguments[1];"
        "slider.dispatchEvent(new Event('input'));",
        entry,
        value,
    )


def complaints(browser: Any) -> list[str]:
    return [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


def test_recorded_walks_play_and_sliders_choose_a_body_that_was_tried(browser: Any, folder: Path) -> None:
    main([str(folder)])
    browser.get((folder / "atlas.html").as_uri())
    until(browser, "shown.walker instanceof Recording && shown.walker.steps > 1")
    first = load_run(folder).designs[0]
    for entry, value in enumerate(first.design.tolist()):
        move_slider(browser, entry, value + 0.01)
    assert until(browser, "shown.body && shown.body.number") == 1
    assert "body 1, first" in browser.find_element("id", "body").text
    before = browser.execute_script("return [...shown.walker.frames.slice(0, 16)]")
    after = browser.execute_script("return [...shown.walker.frames.slice(-16)]")
    assert np.abs(np.subtract(after, before)).max() > 1e-3
    assert complaints(browser) == []


@pytest.fixture(scope="module")
def walking(browser: Any, folder: Path) -> Any:
    """A page whose robot is simulated."""
    main([str(folder), "--mujoco", str(PACKAGE), "--out", str(folder / "simulated.html")])
    browser.get((folder / "simulated.html").as_uri())
    until(browser, "shown.walker instanceof Simulation && shown.walker.steps > 20")
    return browser


@pytest.mark.parametrize("body", [WalkerMorph, AntMorph])
def test_the_page_draws_what_the_figures_draw(browser: Any, folder: Path, body: type[MorphEnv]) -> None:
    main([str(folder)])
    browser.get((folder / "atlas.html").as_uri())
    env = body(seed=0)
    env.rollout(10)
    axes = drawn_axes(env.root)
    found = browser.execute_script("return seen(arguments[0], arguments[1]);", env.capsules().tolist(), axes.tolist())
    np.testing.assert_allclose(found, seen(env.capsules().numpy(), axes), rtol=0, atol=1e-12)


def test_an_ant_stands_on_a_floor_of_squares(browser: Any, folder: Path) -> None:
    main([str(folder)])
    browser.get((folder / "atlas.html").as_uri())
    until(browser, "shown.walker instanceof Recording")
    env = AntMorph(seed=0)
    env.reset()
    painted = browser.execute_script(
        "page.body.axes = arguments[0];"
        "shown.playing = false;"
        "shown.walker = { capsules: () => arguments[1], steps: 0, seconds: 0.05 };"
        "shown.run.extent = extent(seen(arguments[1], arguments[0]));"
        "draw();"
        "const canvas = find('stage');"
        "const pixels = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);"
        "return pixels.data.filter((value, i) => i % 4 === 3 && value > 0).length / (canvas.width * canvas.height);",
        drawn_axes(env.root).tolist(),
        env.capsules().tolist(),
    )
    assert 0.05 < painted < 0.5
    assert complaints(browser) == []


@simulated
def test_a_simulated_robot_moves_while_its_body_changes(walking: Any) -> None:
    before = walking.execute_script("return [...shown.walker.data.qpos]")
    move_slider(walking, 1, 1.7)
    steps = walking.execute_script("return shown.walker.steps")
    until(walking, f"shown.walker.steps > {steps + 20}")
    after = walking.execute_script("return [...shown.walker.data.qpos]")
    assert np.abs(np.subtract(after, before)).max() > 0.01
    assert walking.execute_script("return shown.walker.model.geom_size[3 * 2 + 1]") == pytest.approx(0.225 * 1.7)
    assert walking.find_element("id", "body").text == "A body that the run has not tried."
    assert complaints(walking) == []


@simulated
@pytest.mark.parametrize("body", [HopperMorph, WalkerMorph, HalfCheetahMorph, AntMorph])
def test_the_bodies_of_the_page_are_those_of_the_environment(walking: Any, body: type[MorphEnv]) -> None:
    env = body(seed=0)
    low, high = (bound.numpy() for bound in env.design_bounds())
    fields = ("body_pos", "body_mass", "body_inertia", "geom_pos", "geom_size", "jnt_pos", "qpos0")
    for design in np.random.default_rng(3).uniform(low, high, (3, len(low))):
        found = walking.execute_script(
            "const made = new Simulation(shown.mujoco, arguments[0], null, arguments[1]);"
            "return arguments[2].map((field) => [...made.model[field]]);",
            body_table(env),
            design.tolist(),
            fields,
        )
        wanted = env.simulations.body(design).compile()
        for field, values in zip(fields, found):
            np.testing.assert_allclose(values, getattr(wanted, field).ravel(), rtol=0, atol=1e-9, err_msg=field)


@simulated
@pytest.mark.parametrize("body", [HopperMorph, WalkerMorph, HalfCheetahMorph, AntMorph])
def test_a_step_of_the_page_is_one_of_the_environment(walking: Any, body: type[MorphEnv]) -> None:
    env = body(num_runs=1, reset_noise=0, seed=0)
    low, high = env.design_bounds()
    design = low + 0.7 * (high - low)
    action = torch.linspace(-0.6, 0.8, env.action_spec.shape[-1])
    wanted = [env.reset(TensorDict({"design": design[None]}, [1]))["observation"]]
    wanted += [env.move(action[None])[0] for _ in range(STEPS)]
    found = walking.execute_script(
        "const robot = new Simulation(shown.mujoco, arguments[0], { act: () => arguments[2] }, arguments[1]);"
        "const seen = [robot.observation()];"
        "for (let i = 0; i < arguments[3]; i++) { robot.step(); seen.push(robot.observation()); }"
        "return seen;",
        body_table(env),
        design.tolist(),
        action.tolist(),
        STEPS,
    )
    np.testing.assert_allclose(found, torch.cat(wanted), rtol=0, atol=1e-5)  # single precision there, double here


PARTS = """
<mujoco><asset><mesh name="m" vertex="0 0 0 1 0 0 0 .2 0 0 0 .3"/></asset><worldbody>
  <body name="trunk" pos="0 0 1"><freejoint/>
    <geom type="box" size=".2 .3 .05" euler="10 20 30"/>
    <geom type="ellipsoid" size=".1 .3 .2" pos=".5 0 0"/>
    <geom type="cylinder" size=".3 .1" pos="-.5 0 0"/>
    <geom type="mesh" mesh="m" contype="0" conaffinity="0"/>
    <body name="leg"><joint name="hip" axis="0 1 0"/>
      <geom name="leg" type="capsule" fromto="0 0 0 0 0 -.5" size=".04"/></body>
  </body></worldbody>
  <actuator><motor joint="hip" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


@simulated
def test_the_page_draws_every_shape_as_python_does(walking: Any, tmp_path: Path) -> None:
    (tmp_path / "parts.xml").write_text(PARTS)
    body = morph_from_mjcf(tmp_path / "parts.xml", {"leg": ["leg"]}, reward=lambda o, a, n, design: n[..., :1])
    env = body(num_runs=1, reset_noise=0, seed=0)
    env.reset()
    found = walking.execute_script(
        "return new Simulation(shown.mujoco, arguments[0], null, [1]).capsules();", body_table(env)
    )
    np.testing.assert_allclose(found, env.capsules(), rtol=0, atol=1e-6)


@simulated
def test_the_actions_of_the_page_are_those_of_the_policy(walking: Any, folder: Path) -> None:
    policy = load_run(folder, run=0).population.policy
    observation, design = torch.randn(1, 11, generator=torch.Generator().manual_seed(0)), torch.full((1, 4), 1.3)
    found = walking.execute_script(
        "return new Policy(shown.run.policies['of all bodies']).act(arguments[0], arguments[1]);",
        observation[0].tolist(),
        design[0].tolist(),
    )
    wanted = policy.deterministic_action(observation, design)[0].tolist()
    assert found == pytest.approx(wanted, abs=1e-5)
