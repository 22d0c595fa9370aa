"""Bodies stepped by MuJoCo Warp: they move as MuJoCo moves them, to float32, each by its own lengths.

MuJoCo Warp is not among what `make test` installs: its kernels take half a minute to compile. `make gpu` has it, and so
has an environment with `pip install -e '.[warp]'`.
"""

from __future__ import annotations

import pickle
import sys
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

import coim.envs
from coim import AntMorph, HopperMorph, MorphEnv, make_policy, morph_from_mjcf, run_episode

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
    """Largest difference of what both see after a step from the same state."""
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


def robot(folder: Path, xml: str, scale: dict[str, list[str]]) -> type[MorphEnv]:
    """A kind of robot, with a reward that is always 0."""
    path = folder / "robot.xml"
    path.write_text(xml)
    return morph_from_mjcf(path, scale, lambda *rows: 0 * rows[0][..., :1])


ARM = """
<mujoco><option timestep="0.005"/>
  <worldbody><body name="post">
    <geom name="post" type="capsule" fromto="0 0 0 0 0 1" size=".05" contype="0" conaffinity="0"/>
    <geom name="shelf" type="box" pos=".2 0 .7" size=".1 .2 .02"/>
    <site name="nail" pos="0 0 1.5"/>
    <body name="arm" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" {joint}/>
      <geom name="arm" type="capsule" fromto="0 0 0 .5 0 0" size=".03"/>
      <site name="elbow" pos=".2 0 0"/><site name="hand" pos=".5 0 0"/>
    </body>
  </body></worldbody>
  {equality}
  <actuator><motor joint="shoulder" ctrlrange="-1 1" {motor}/></actuator>
</mujoco>
"""


def arm(folder: Path, *, joint: str = "", equality: str = "", motor: str = "") -> type[MorphEnv]:
    """On a post with a shelf, which never move."""
    return robot(folder, ARM.format(joint=joint, equality=equality, motor=motor), {"post": ["post"]})


@needs_warp
def test_what_never_moves_stands_where_each_design_puts_it(tmp_path: Path) -> None:
    kind = arm(tmp_path)
    posts = TensorDict({"design": torch.tensor([[1.0], [0.7]])}, [2])
    ends = []
    for physics in ("warp", "mujoco"):
        env = kind(num_runs=2, reset_noise=0.0, seed=0, physics=physics)
        env.reset(posts)
        for _ in range(100):
            observation, _ = env.move(torch.zeros(2, 1))
        ends.append(observation)
    assert abs(float(ends[1][0, 0] - ends[1][1, 0])) > 0.1  # an arm on its shelf, the other one lower
    torch.testing.assert_close(*ends, rtol=0, atol=1e-2)


@needs_warp
def test_a_free_robot_moves_as_mujoco_moves_it_with_elliptic_cones(tmp_path: Path) -> None:
    xml = (Path(coim.envs.__file__).parent / "assets" / "ant.xml").read_text()
    assert 'integrator="RK4"' in xml
    free = robot(
        tmp_path, xml.replace('integrator="RK4"', 'integrator="RK4" cone="elliptic"'), {"legs": ["front_left_shin"]}
    )
    env, truth = free(num_runs=2, physics="warp", seed=0), free(num_runs=2, seed=0)
    env.reset(), truth.reset()
    generator, found = torch.Generator().manual_seed(1), []
    for _ in range(40):
        action = 2 * torch.rand(2, 8, generator=generator) - 1
        env.set_simulation_state(truth.get_simulation_state())
        found.append((env.move(action)[0] - truth.move(action)[0]).abs().max())
    assert max(found) < 1e-3


@needs_warp
@pytest.mark.parametrize("kept", [{"motor": 'delay="0.02" nsample="8"'}, {"joint": 'stiffness="5" springyield="0.2"'}])
def test_what_would_outlast_a_reset_is_refused(kept: dict[str, str], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="has delays or joints that stay bent, which MuJoCo Warp would keep"):
        arm(tmp_path, **kept)(physics="warp")


@needs_warp
def test_a_device_that_cannot_compute_is_refused() -> None:
    with pytest.raises(ValueError, match=r"MuJoCo Warp cannot compute on 'meta' .*; take cuda, or cpu"):
        HopperMorph(physics="warp", device="meta")


@needs_warp
def test_equalities_have_room(tmp_path: Path) -> None:
    welds = "".join(f'<weld site1="nail" site2="{site}"/>' for site in ("elbow", "hand"))
    env = arm(tmp_path, equality=f"<equality>{welds}</equality>")(physics="warp", seed=0)
    env.reset()
    env.move(torch.zeros(1, 1))
    # Four sides of the pyramids of 16 contacts, a joint with its velocity, and two welds.
    assert env.simulations._worlds._data.njmax == 4 * 16 + 2 + 2 * 6


@needs_warp
def test_a_step_brings_all_that_it_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    env = HopperMorph(num_runs=K, physics="warp", seed=0)
    env.reset(designs(0))
    state = env.get_simulation_state()
    state["simulation"] = torch.rand(state["simulation"].shape, dtype=torch.float64)
    env.set_simulation_state(state)
    monkeypatch.setattr(mujoco_warp, "step", lambda model, data: None)
    env.simulations.step(1)
    data = env.simulations._worlds._data
    for name in ("qpos", "qvel", "qacc_warmstart", "ctrl"):
        expected = env.simulations._batch.bind(name).astype(np.float32)
        assert np.array_equal(getattr(data, name).numpy(), expected), name


@needs_warp
def test_another_order_of_fields_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    made = mujoco_warp.put_model

    def reordered(model: mujoco.MjModel, **sizes: object) -> object:
        found = made(model, **sizes)
        found.body_mass.assign(found.body_mass.numpy()[:, ::-1].copy())
        return found

    monkeypatch.setattr(mujoco_warp, "put_model", reordered)
    with pytest.raises(ValueError, match="keeps 'body_mass' in an order of its own"):
        HopperMorph(physics="warp")


@needs_warp
@pytest.mark.parametrize("name", ["geom_priority", "opt.timestep", "actuator_biasprm", "actuator_gainprm"])
def test_bodies_that_differ_in_what_worlds_share_are_refused(name: str) -> None:
    """Alone too: what is shared was taken from the body at xi = 1."""

    class Odd(HopperMorph):
        def shape_body(self, spec: mujoco.MjSpec, design: np.ndarray) -> None:
            super().shape_body(spec, design)
            if design[0] > 1:
                spec.geoms[-1].priority = name == "geom_priority"
                spec.option.timestep *= 0.5 if name == "opt.timestep" else 1
                spec.actuators[0].gainprm[0] = 2 if name == "actuator_gainprm" else 1
                if name == "actuator_biasprm":
                    spec.actuators[0].biastype = mujoco.mjtBias.mjBIAS_AFFINE
                    spec.actuators[0].biasprm[1] = -1

    env = Odd(physics="warp", seed=0)
    before, body = env.get_simulation_state(), env.simulations.model(0)
    with pytest.raises(ValueError, match=f"differs from the first in '{name}', which bodies share with MuJoCo Warp"):
        env.reset(TensorDict({"design": torch.tensor([[1.5, 1.0, 1.0, 1.0]])}, [1]))
    assert env.simulations.model(0) is body
    assert torch.equal(env.get_simulation_state()["design"], before["design"])
    env.move(torch.zeros(1, 3))
    plain = HopperMorph(physics="warp", seed=0)
    plain.set_simulation_state(before)
    plain.move(torch.zeros(1, 3))
    assert np.array_equal(env.simulations.state, plain.simulations.state)
    env.simulations.start(np.arange(1))  # in the pose of the body that it still has
    assert np.array_equal(env.simulations.qpos[0], body.qpos0)


@needs_warp
@pytest.mark.parametrize(
    ("size", "message"),
    [
        ("njmax", "body 0 has more than 1 constraints, of contacts"),
        ("naconmax", "the bodies touch in more than 1 places"),
    ],
)
def test_what_has_no_room_is_told_and_nothing_moves(size: str, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    made = mujoco_warp.make_data
    monkeypatch.setattr(mujoco_warp, "make_data", lambda model, **sizes: made(model, **(sizes | {size: 1})))
    env = HopperMorph(num_runs=K, physics="warp", seed=0)
    env.reset()
    env.simulations.qpos[:, 1] += 1  # in the air
    flying = env.get_simulation_state()
    env.simulations.qpos[:, 1] -= 1.1  # the soles are in the floor
    before = env.get_simulation_state()
    with pytest.raises(RuntimeError, match=message):
        env.simulations.step(1)
    assert torch.equal(env.get_simulation_state()["simulation"], before["simulation"])
    env.set_simulation_state(flying)
    env.simulations.step(1)  # what did not fit before is forgotten


@needs_warp
def test_there_is_room_for_four_contacts_of_each_part() -> None:
    data = AntMorph(num_runs=2, physics="warp").simulations._worlds._data
    assert (data.naconmax, data.njmax) == (2 * 13 * 4, 13 * 4 * 4 + 9 + 14)  # 9 joints, 14 velocities


def test_other_physics_and_a_missing_package_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="physics 'bullet' is neither 'mujoco' nor 'warp'"):
        HopperMorph(physics="bullet")
    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(ImportError, match=r"pip install 'coim\[warp\]', or physics='mujoco'"):
        HopperMorph(physics="warp")
