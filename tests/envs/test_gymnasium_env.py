"""Bodies in Gymnasium: the same physics and reward, bodies by episode, and what Gymnasium's own check says."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from tensordict import TensorDict

import coim  # noqa: F401  (its bodies are in Gymnasium's registry)
from coim.envs import BODIES, GymnasiumEnv, HalfCheetahMorph, HopperMorph

IDS = {f"coim/{body.__name__.removesuffix('Morph')}-v0": body for body in BODIES.values()}
BODY = [1.5, 0.6, 0.9, 1.25]  # exact in float32 or not


def registered() -> set[str]:
    return {name for name in gymnasium.registry if name.startswith("coim/")}


def test_every_body_is_registered() -> None:
    assert registered() == set(IDS)


@pytest.mark.parametrize("name", IDS)
def test_gymnasiums_check_has_no_complaint(name: str) -> None:
    env = gymnasium.make(name, design="random")
    check_env(env.unwrapped, skip_render_check=True)  # pictures: test_camera.py
    assert env.metadata["render_fps"] == round(1 / IDS[name](seed=0).step_seconds)


def test_physics_and_reward_are_those_of_the_torchrl_environment_to_the_last_bit() -> None:
    env, bodies = gymnasium.make("coim/Hopper-v0", design=BODY, task="backward"), HopperMorph(task="backward", seed=7)
    row = bodies.reset(TensorDict({"design": torch.tensor([BODY])}, [1]))
    observation, info = env.reset(seed=7)
    actions = np.random.default_rng(0).uniform(-1, 1, (40, 3)).astype(np.float32)
    for action in actions:
        assert (observation == torch.cat([row["observation"], row["design"]], -1).numpy()[0]).all()
        row = bodies.step(row.set("action", torch.from_numpy(action)[None]))["next"]
        observation, reward, terminated, truncated, _ = env.step(action)
        assert (reward, terminated, truncated) == (row["reward"].item(), False, False)
    assert info["design"].tolist() == row["design"][0].tolist()


def test_a_reset_builds_the_body_that_its_options_name_and_keeps_it() -> None:
    env = GymnasiumEnv(HopperMorph, observe_design=False, reset_noise=0)
    unit, info = env.reset()
    assert (unit.shape, info["design"].tolist()) == ((11,), [1, 1, 1, 1])
    long, info = env.reset(options={"design": [1, 2, 1, 1]})
    assert long[0] - unit[0] == pytest.approx(0.45)  # m: a thigh twice as long
    assert info["design"].tolist() == [1, 2, 1, 1]
    again, info = env.reset()
    assert (again == long).all()
    assert info["design"].tolist() == [1, 2, 1, 1]


def test_random_bodies_follow_the_seed_and_differ_between_episodes() -> None:
    def bodies(env: gymnasium.Env[Any, Any]) -> list[list[float]]:
        return [env.reset(seed=seed)[1]["design"].tolist() for seed in (3, None, None)]

    drawn = bodies(gymnasium.make("coim/Hopper-v0", design="random"))
    assert drawn == bodies(gymnasium.make("coim/Hopper-v0", design="random"))
    assert len({tuple(body) for body in drawn}) == 3
    assert all(0.5 <= entry <= 2.0 for body in drawn for entry in body)
    env = gymnasium.make("coim/Hopper-v0")
    _, info = env.reset(seed=3, options={"design": "random"})
    assert info["design"].tolist() == drawn[0]


def test_vectors_of_environments_have_a_body_each_and_a_time_limit() -> None:
    fleet = gymnasium.make_vec("coim/HalfCheetah-v0", num_envs=2, design="random", max_episode_steps=3)
    observation, info = fleet.reset(seed=0)
    assert observation.shape == (2, 17 + 6)
    assert (observation[:, 17:] == info["design"]).all()
    assert (info["design"][0] != info["design"][1]).any()
    for over in (False, False, True):
        _, _, _, truncated, _ = fleet.step(fleet.action_space.sample())
        assert truncated.tolist() == [over, over]
    fleet.close()


def test_a_broken_simulation_is_terminated_with_its_last_finite_observation() -> None:
    env = GymnasiumEnv(HopperMorph, observe_design=False)
    before, _ = env.reset(seed=0)
    env.bodies.simulations.qvel[:] = 1e7
    observation, _, terminated, truncated, _ = env.step(np.zeros(3, np.float32))
    assert (terminated, truncated) == (True, False)
    assert (observation == before).all()
    assert observation in env.observation_space


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda: GymnasiumEnv(HopperMorph, design=[1, 1]), r"must be 4 numbers: torso in \[0.5, 2\], thigh in"),
        (lambda: GymnasiumEnv(HopperMorph, design=[1, 1, 1, 9]), r"\[1.0, 1.0, 1.0, 9.0\], it must be 4 numbers"),
        (lambda: GymnasiumEnv(HopperMorph, design="any"), "design is 'any', it must be 4 numbers or 'random'"),
        (lambda: GymnasiumEnv("WorldModelEnv"), "body is 'WorldModelEnv', it must be a class"),
        (lambda: GymnasiumEnv(HopperMorph, render_mode="ascii"), "it must be one of human, rgb_array"),  # type: ignore[arg-type]
        (lambda: GymnasiumEnv(HopperMorph).reset(options={"desing": 1}), "options has 'desing'; the only option"),
        (lambda: GymnasiumEnv(HopperMorph).step(np.zeros(2, np.float32)), r"shape \[1, 2\]"),
    ],
)
def test_what_cannot_be_is_refused(make: Callable[[], Any], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        make()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems always have a display")
def test_a_window_without_a_display_is_refused_in_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(RuntimeError, match=r"a window needs a display, .* take render_mode='rgb_array'"):
        gymnasium.make("coim/Hopper-v0", render_mode="human")


def test_a_window_shows_each_pose_in_real_time_and_is_opened_anew_for_another_body(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shown: list[tuple[int, float]] = []  # which window, height of the torso

    class Handle(SimpleNamespace):
        def sync(self) -> None:
            shown.append((self.number, self.data.qpos[1]))

    opened: list[Handle] = []

    def launch(model: Any, data: Any, **_: bool) -> Handle:
        parts = {"lock": nullcontext, "is_running": lambda: True, "close": lambda: None}
        opened.append(Handle(number=len(opened), data=data, cam=mujoco.MjvCamera(), **parts))
        return opened[-1]

    monkeypatch.setenv("DISPLAY", ":made-up")
    monkeypatch.setitem(sys.modules, "mujoco.viewer", SimpleNamespace(launch_passive=launch))
    monkeypatch.setattr("mujoco.viewer", sys.modules["mujoco.viewer"], raising=False)
    env = GymnasiumEnv(HalfCheetahMorph, render_mode="human")
    began = time.monotonic()
    env.reset(seed=0)
    for _ in range(2):
        env.step(np.zeros(6, np.float32))
    assert time.monotonic() - began >= 2 * 0.05  # s a step
    assert [number for number, _ in shown] == [0, 0, 0]
    assert shown[-1][1] == env.bodies.simulations.qpos[0, 1]
    env.reset(options={"design": [2.0] * 6})
    assert shown[-1] == (1, env.bodies.simulations.qpos[0, 1])
    env.close()


def test_stable_baselines_learns_on_it() -> None:
    """2,000 steps of PPO raise the return of episodes of 50 steps by a seventh or more (a quarter or more was seen)."""
    ppo = pytest.importorskip("stable_baselines3").PPO
    from stable_baselines3.common.env_util import make_vec_env

    torch.set_num_threads(1)
    fleet = make_vec_env("coim/Hopper-v0", n_envs=8, seed=0, env_kwargs={"max_episode_steps": 50})
    model = ppo(
        "MlpPolicy", fleet, n_steps=50, batch_size=400, learning_rate=3e-3, gamma=0.95, seed=0, device="cpu",
        policy_kwargs={"net_arch": [32, 32]},
    )  # fmt: skip
    returns = []
    for _ in range(5):
        model.learn(400, reset_num_timesteps=False)
        returns.append(np.mean([episode["r"] for episode in model.ep_info_buffer][-8:]))
    assert returns[-1] > 8 / 7 * returns[0]
