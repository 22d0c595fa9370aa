"""Bodies stepped by MuJoCo Warp: they move as MuJoCo moves them, to float32, each by its own lengths.

MuJoCo Warp is not among what `make test` installs: its kernels take half a minute to compile. `make gpu` has it, and so
has an environment with `pip install -e '.[warp]'`.
"""

from __future__ import annotations

import pickle
import sys
from collections.abc import Iterator

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from coim import HopperMorph, MorphEnv, make_policy, run_episode

try:
    import mujoco_warp
except ImportError:
    mujoco_warp = None

needs_warp = pytest.mark.skipif(mujoco_warp is None, reason="MuJoCo Warp is not installed: pip install -e '.[warp]'")
K = 3


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> str:
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("no GPU")
    return request.param


def designs(seed: int) -> TensorDict:
    low, high = HopperMorph.design_bounds()
    share = torch.rand(K, len(low), generator=torch.Generator().manual_seed(seed))
    return TensorDict({"design": (low + share * (high - low)).float()}, [K])


def actions(steps: int) -> Iterator[torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    for _ in range(steps):
        yield 2 * torch.rand(K, 3, generator=generator) - 1


def largest_difference(env: MorphEnv, truth: MorphEnv, steps: int) -> float:
    """Of what both see after a step from the same state."""
    differences = []
    for action in actions(steps):
        truth.set_simulation_state(env.get_simulation_state())
        differences.append((env.move(action)[0].cpu() - truth.move(action)[0]).abs().max())
    return float(max(differences))


@needs_warp
def test_each_body_moves_as_mujoco_moves_it_and_so_do_the_next_bodies(device: str) -> None:
    env, truth = HopperMorph(num_runs=K, physics="warp", device=device, seed=0), HopperMorph(num_runs=K, seed=0)
    for seed in (0, 1):
        env.reset(designs(seed).to(device))
        assert largest_difference(env, truth, 40) < 1e-3
    assert env.simulations.state[0, 0] == pytest.approx(40 * env.step_seconds)  # the clock


@needs_warp
def test_a_broken_simulation_starts_again_and_the_others_go_on(device: str) -> None:
    env = HopperMorph(num_runs=K, physics="warp", device=device, seed=0)
    env.reset()
    env.simulations.qvel[1] = 1e9
    action = torch.zeros(K, 3, device=device)
    _, terminated = env.move(action)
    assert terminated[:, 0].tolist() == [False, True, False]
    assert env.num_broken.tolist() == [0, 1, 0]
    observation, terminated = env.move(action)
    assert observation.isfinite().all()
    assert not terminated.any()


@needs_warp
def test_a_copy_goes_on_from_the_same_state(device: str) -> None:
    env = HopperMorph(num_runs=K, physics="warp", device=device, seed=0)
    env.reset(designs(0).to(device))
    for action in actions(3):
        env.move(action)
    copy = pickle.loads(pickle.dumps(env))
    assert np.array_equal(copy.simulations.state, env.simulations.state)
    action = next(actions(1))
    torch.testing.assert_close(copy.move(action)[0], env.move(action)[0], rtol=0, atol=1e-4)


@needs_warp
def test_episodes_are_not_native(device: str) -> None:
    env = HopperMorph(num_runs=K, episode_steps=5, physics="warp", device=device, seed=0)
    policy = make_policy(env, num_cells=(8,)).to(device)
    start = env.get_simulation_state()
    episodes = []
    for native in (False, True):
        env.set_simulation_state(start)
        episodes.append(run_episode(env, policy, deterministic=True, native=native)["next", "observation"])
    torch.testing.assert_close(*episodes, rtol=0, atol=1e-4)
    with pytest.raises(RuntimeError, match="native code steps bodies by MuJoCo, and these are stepped by MuJoCo Warp"):
        env.simulations.apply(None, None, np.arange(K))


@needs_warp
@pytest.mark.parametrize("name", ["geom_priority", "opt.timestep", "actuator_biasprm"])
def test_bodies_that_differ_in_what_worlds_share_are_refused(name: str) -> None:
    """Alone too: what is shared was taken from the body at xi = 1."""

    class Odd(HopperMorph):
        def shape_body(self, spec: mujoco.MjSpec, design: np.ndarray) -> None:
            super().shape_body(spec, design)
            if design[0] > 1:
                spec.geoms[-1].priority = name == "geom_priority"
                spec.option.timestep *= 0.5 if name == "opt.timestep" else 1
                if name == "actuator_biasprm":
                    spec.actuators[0].biastype = mujoco.mjtBias.mjBIAS_AFFINE
                    spec.actuators[0].biasprm[1] = -1

    env = Odd(physics="warp", seed=0)
    before, body = env.get_simulation_state(), env.simulations.model(0)
    with pytest.raises(ValueError, match=f"differs from the first in '{name}', of which MuJoCo Warp has one for all"):
        env.reset(TensorDict({"design": torch.tensor([[1.5, 1.0, 1.0, 1.0]])}, [1]))
    assert env.simulations.model(0) is body
    assert torch.equal(env.get_simulation_state()["design"], before["design"])
    env.move(torch.zeros(1, 3))


@needs_warp
def test_contacts_without_room_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    made = mujoco_warp.make_data
    monkeypatch.setattr(mujoco_warp, "make_data", lambda model, **sizes: made(model, **(sizes | {"njmax": 1})))
    env = HopperMorph(num_runs=K, physics="warp", seed=0)
    env.reset()
    env.simulations.qpos[:, 1] -= 0.1  # the soles are in the floor
    with pytest.raises(RuntimeError, match="body 0 touches more than MuJoCo Warp was given room for"):
        env.move(next(actions(1)))


def test_other_physics_and_a_missing_package_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="physics 'bullet' is neither 'mujoco' nor 'warp'"):
        HopperMorph(physics="bullet")
    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(ImportError, match=r"pip install 'coim\[warp\]', or physics='mujoco'"):
        HopperMorph(physics="warp")
