"""Robots that are no planar runners: one that moves freely through space, and an arm on a fixed base."""

from __future__ import annotations

import math
from pathlib import Path
from typing import ClassVar

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import check_env_specs
from two_link_arm import TWO_LINK_ARM

from coim.envs import MorphEnv, SimulatorDynamics, WorldModelEnv
from coim.envs.blueprint import observed
from coim.envs.simulation import lowest_point
from coim.models import GaussianEnsemble

DRONE = """
<mujoco><option timestep=".005"/>
  <worldbody><body name="hub" pos="0 0 .3">
    <freejoint/>
    <geom name="hub" type="ellipsoid" size=".2 .1 .05"/>
    <geom name="crate" type="box" size=".1 .05 .05" pos="0 0 -.1" euler="0 20 0"/>
    <geom name="sign" type="mesh" mesh="sign" contype="0" conaffinity="0"/>
    <body name="boom" pos=".2 0 0">
      <joint name="boom" axis="0 1 0" range="-60 60"/>
      <geom name="boom" type="cylinder" fromto="0 0 0 .3 0 .1" size=".04"/>
      <geom name="tip" type="sphere" pos=".35 0 .1" size=".06"/>
    </body>
  </body></worldbody>
  <actuator><motor joint="boom" gear="3" ctrlrange="-1 1"/></actuator>
  <asset><mesh name="sign" vertex="0 0 0 1 0 0 0 1 0 0 0 -9"/></asset>
</mujoco>
"""


class Stretched(MorphEnv):
    """Bodies of this file, of two parts."""

    DESIGN_SIZE = 2
    DESIGN_BOUNDS = ((0.5, 2.0), (0.8, 1.2))
    FRAME_SKIP = 2
    RESET_NOISE = 0.1
    FIRST_DESIGNS: ClassVar = ((1.0, 1.0), (1.5, 0.9))

    @staticmethod
    def reward(
        observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor, task: str = "forward"
    ) -> Tensor:
        return -action.square().mean(-1, keepdim=True)


class Arm(Stretched):
    OBSERVATION_SCALE = (1.0,) * 4

    def shape_body(self, spec: mujoco.MjSpec, design: np.ndarray) -> None:
        upper, lower = design * (0.5, 0.4)
        spec.geom("upper").fromto, spec.geom("lower").fromto = [0, 0, 0, upper, 0, 0], [0, 0, 0, lower, 0, 0]
        spec.body("lower").pos = [upper, 0, 0]


class Drone(Stretched):
    OBSERVATION_SCALE = (1.0,) * 13

    def shape_body(self, spec: mujoco.MjSpec, design: np.ndarray) -> None:
        spec.body("boom").pos = [0.2 * design[0], 0, 0]
        spec.geom("boom").fromto = [0, 0, 0, 0.3 * design[1], 0, 0.1 * design[1]]


@pytest.fixture(scope="module", autouse=True)
def files(tmp_path_factory: pytest.TempPathFactory) -> None:
    folder: Path = tmp_path_factory.mktemp("robots")
    for body, text in ((Arm, TWO_LINK_ARM), (Drone, DRONE)):
        body.ASSET = str(folder / f"{body.__name__}.xml")
        Path(body.ASSET).write_text(text)


@pytest.mark.parametrize("body", [Arm, Drone])
def test_specs_hold_and_designs_enter_at_reset(body: type[MorphEnv]) -> None:
    env = body(num_runs=3, seed=0)
    check_env_specs(env)
    designs = env.design_spec.expand(3, 2).rand()
    rows = env.rollout(5, auto_reset=False, tensordict=env.reset(TensorDict({"design": designs}, [3])))
    assert rows["next", "design"].equal(designs[:, None].expand(3, 5, 2))
    assert len({float(env.simulations.model(row).body_mass.sum()) for row in range(3)}) == 3


def test_an_action_of_one_is_the_end_of_a_motors_range() -> None:
    env = Arm(num_runs=3)
    env.reset()
    env.move(torch.tensor([[1.0, 1.0], [-1.0, -1.0], [0.0, 0.5]]))
    assert env.simulations.ctrl.tolist() == [[2.0, 3.0], [-2.0, 0.0], [0.0, 2.25]]


def test_each_entry_of_a_design_has_its_own_bounds() -> None:
    env = Arm()
    assert env.design_spec.project(torch.full((2,), 9.0)).tolist() == pytest.approx([2.0, 1.2])
    with pytest.raises(ValueError, match=r"design \[\[1.5, 1.5\]\] with its design 1 leaves \[0.8, 1.2\]; clip it"):
        env.reset(TensorDict({"design": torch.tensor([[1.5, 1.5]])}, [1]))


@pytest.mark.parametrize("bounds", [((0.5, 2.0),) * 3, ((0.5, 2.0), (1.1, 2.0)), (0.5, 1.0, 2.0), ((0.5, 2.0), (2.0,))])
def test_bounds_that_do_not_fit_the_design_are_refused(bounds: object) -> None:
    with pytest.raises(ValueError, match=r"Odd.DESIGN_BOUNDS is .*; it is one pair .*, or 2 such pairs"):
        type("Odd", (Arm,), {"DESIGN_BOUNDS": bounds})()


def test_an_arm_stands_where_it_is_bolted_and_its_endless_joint_comes_round() -> None:
    env = Arm(num_runs=2, seed=0, reset_noise=0.0)
    env.reset()
    env.simulations.qpos[:, 0] = [1.0, 1.0 + 2 * math.tau]
    observation = env.move(torch.zeros(2, 2))[0]
    assert env.simulations.qpos[1, 0] > 12  # the joint itself has gone on turning
    torch.testing.assert_close(observation[0], observation[1])
    assert (env.angle_indices, env.quaternion_index) == ((0,), None)
    assert observation.shape == (2, 4)
    with pytest.raises(ValueError, match="nothing moves this body up and down"):
        env.clearance(observation, env.reset()["design"])


def test_a_free_body_gets_a_floor_and_starts_above_it_whatever_the_noise() -> None:
    env = Drone(num_runs=20, seed=0, reset_noise=0.3)
    observation = env.reset()["observation"]
    assert env.simulations.model(0).geom("floor").type == mujoco.mjtGeom.mjGEOM_PLANE
    lowest = torch.tensor([env.simulations.lowest_point(row) for row in range(20)])
    assert lowest.min() >= -1e-12
    assert 0.05 < (lowest < 1e-9).float().mean() < 0.95  # some are lifted, and stand on it
    torch.testing.assert_close(observation[:, 1:5].norm(dim=-1), torch.ones(20))
    assert (env.angle_indices, env.quaternion_index) == ((), 1)


def test_the_lowest_point_is_that_of_points_all_over_each_shape() -> None:
    env = Drone()
    model = env.simulations.model(0)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    on_sphere = rng.normal(size=(20_000, 3))
    on_sphere /= np.linalg.norm(on_sphere, axis=1, keepdims=True)
    rim = on_sphere / np.linalg.norm(on_sphere[:, :2], axis=1, keepdims=True)
    for part, points in (("hub", on_sphere), ("crate", np.sign(on_sphere)), ("boom", rim), ("tip", on_sphere)):
        alone = model.__copy__()
        alone.geom_contype[:], alone.geom_conaffinity[:] = 0, 0
        alone.geom(part).contype = 1
        size = alone.geom(part).size
        shape = points * {"boom": (size[0], size[0], size[1]), "tip": (size[0],) * 3}.get(part, tuple(size))
        shape[:, 2] = np.clip(shape[:, 2], -size[1], size[1]) if part == "boom" else shape[:, 2]
        for _ in range(5):
            data.qpos[:] = rng.normal(size=model.nq)
            mujoco.mj_kinematics(alone, data)
            world = data.geom(part).xpos + shape @ data.geom(part).xmat.reshape(3, 3).T
            assert lowest_point(alone, data) == pytest.approx(world[:, 2].min(), abs=5e-3)


def test_clearance_and_transfer_serve_a_free_body_in_any_pose() -> None:
    env, generator = Drone(), torch.Generator().manual_seed(0)
    observation = 2 * torch.rand(40, 13, generator=generator, dtype=torch.float64) - 1
    low, high = env.design_bounds()
    design = low + (high - low) * torch.rand(40, 2, generator=generator, dtype=torch.float64)
    truth = []
    for row, body in zip(observation, design):
        model = env.simulations.body(body.numpy()).compile()
        data = mujoco.MjData(model)
        data.qpos[2:] = row[:6].numpy()
        mujoco.mj_kinematics(model, data)
        truth.append(lowest_point(model, data))
    assert env.clearance(observation, design).squeeze(-1).numpy() == pytest.approx(truth, abs=1e-9)
    other = design.flip(0)
    moved = env.transfer(observation, design, other)
    assert (moved != observation).any(0).nonzero().flatten().tolist() == [0]
    torch.testing.assert_close(env.clearance(moved, other), env.clearance(observation, design))
    few = (observation[:3].requires_grad_(), design[:3].requires_grad_())
    assert torch.autograd.gradcheck(env.clearance, few)


def test_the_dream_keeps_orientations_and_wraps_nothing() -> None:
    env = Drone(num_runs=2, seed=0)
    ensemble = GaussianEnsemble.for_env(env, num_cells=(8,))
    assert ensemble.angle_indices == ()
    dream = WorldModelEnv(ensemble, env, batch_size=[5], seed=0)
    observation = torch.full((5, 13), 4.0)
    action, design = torch.zeros(5, 1), torch.ones(5, 2)
    following = dream.advance(observation, action, design)[0]
    torch.testing.assert_close(following[:, 1:5].norm(dim=-1), torch.ones(5))
    assert (following[:, [0, *range(5, 13)]] > 2 * math.pi / 3).any()
    real = TensorDict({"observation": observation, "action": action, "design": design}, [5])
    real["next", "observation"] = torch.full((5, 13), 0.5)
    torch.testing.assert_close(dream.advance_beside(real, observation, action, design)[0], torch.full((5, 13), 0.5))


@pytest.mark.parametrize("body", [Arm, Drone])
def test_the_simulator_as_a_dream_takes_up_any_state(body: type[MorphEnv]) -> None:
    env = body(num_runs=2, seed=0)
    dream = WorldModelEnv(SimulatorDynamics(body(num_runs=2)), env, batch_size=[2], seed=0)
    here = env.reset()
    action = torch.zeros(2, env.action_spec.shape[-1])
    predicted = dream.advance(here["observation"], action, here["design"])[0]
    torch.testing.assert_close(predicted, env.move(action)[0], atol=1e-5, rtol=1e-5)


def test_a_joint_without_a_name_is_called_by_what_it_moves() -> None:
    named = [name for name, _ in observed(Drone(num_runs=1))]
    assert len(named) == 13
    assert named[:2] == ["z of hub", "w of the quaternion of hub"]
    assert "velocity of hub along x" in named
