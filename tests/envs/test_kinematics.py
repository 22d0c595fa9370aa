"""Clearance and transfer: heights of bodies as torch functions, held against MuJoCo's own geometry."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from coim import morph_from_mjcf
from coim.envs import BODIES, HalfCheetahMorph, HopperMorph, MorphEnv, WalkerMorph
from coim.envs.kinematics import Kinematics

ROWS = 100
HOPPER = Path(__file__).parents[2] / "coim/envs/assets/hopper.xml"


def any_poses(env: MorphEnv, rows: int = ROWS) -> tuple[Tensor, Tensor]:
    """Observations of any pose, also upside down, and designs, ``[rows, ...]`` float64."""
    generator = torch.Generator().manual_seed(0)
    size = env.observation_spec["observation"].shape[-1]
    low, high = env.design_bounds()
    observation = 7 * torch.rand(rows, size, generator=generator, dtype=torch.float64) - 3.5
    return observation, low + (high - low) * torch.rand(rows, env.DESIGN_SIZE, generator=generator, dtype=torch.float64)


def lowest_point(env: MorphEnv, observation: Tensor, design: Tensor) -> float:
    """The lowest point of the body's capsules by MuJoCo's kinematics, in m."""
    model = env.simulations.body(design.numpy()).compile()
    data = mujoco.MjData(model)
    seen = observation.numpy()[: model.nq - env.first_position]
    data.qpos[env.first_position :] = seen
    mujoco.mj_kinematics(model, data)
    of_robot = model.geom_bodyid > 0
    radius, half = model.geom_size[of_robot, 0], model.geom_size[of_robot, 1]
    return float((data.geom_xpos[of_robot, 2] - radius - half * np.abs(data.geom_xmat[of_robot, 8])).min())


@pytest.mark.parametrize("name", BODIES)
def test_clearance_is_the_lowest_point_of_mujocos_geometry_in_any_pose(name: str) -> None:
    env = BODIES[name]()
    observation, design = any_poses(env)
    truth = [lowest_point(env, row, body) for row, body in zip(observation, design)]
    assert env.clearance(observation, design).squeeze(-1).numpy() == pytest.approx(truth, abs=1e-12)
    single = env.clearance(observation.float(), design.float()).squeeze(-1)
    assert single.numpy() == pytest.approx(truth, abs=3e-6)


@pytest.mark.parametrize("name", BODIES)
def test_a_transferred_state_keeps_its_joints_velocities_and_clearance_and_comes_back(name: str) -> None:
    env = BODIES[name]()
    observation, design = any_poses(env)
    other = design.flip(0)
    moved = env.transfer(observation, design, other)
    changed = (moved != observation).any(0)
    assert changed.nonzero().flatten().tolist() == [
        env._kinematics.height - env.first_position
    ]  # the height of the root
    torch.testing.assert_close(env.clearance(moved, other), env.clearance(observation, design))
    torch.testing.assert_close(env.transfer(moved, other, design), observation)


def test_a_planar_runner_with_a_box_for_a_foot_and_a_ball_for_a_torso(tmp_path: Path) -> None:
    text = HOPPER.read_text()
    for capsule, other in (
        ('name="torso" size=".05 .2"', 'name="torso" type="sphere" size=".2"'),
        ('size=".06 .195"', 'type="box" size=".03 .06 .2"'),
    ):
        assert capsule in text
        text = text.replace(capsule, other)
    (tmp_path / "boxed.xml").write_text(text)
    body = morph_from_mjcf(tmp_path / "boxed.xml", {"thigh": ["thigh"], "shank": ["leg"]}, HopperMorph.reward)
    env = body(num_runs=3, seed=0)
    observation, design = any_poses(env)
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3).numpy() * (0.03, 0.06, 0.2)
    truth = []
    for row, factors in zip(observation, design):
        model = env.simulations.body(factors.numpy()).compile()
        data = mujoco.MjData(model)
        data.qpos[1:] = row.numpy()[: model.nq - 1]
        mujoco.mj_kinematics(model, data)
        foot, torso = data.geom("foot"), data.geom("torso")
        others = [
            data.geom(name).xpos[2] - model.geom(name).size[0] - model.geom(name).size[1] * abs(data.geom(name).xmat[8])
            for name in ("thigh", "leg")
        ]
        of_foot = foot.xpos[2] + (corners @ foot.xmat.reshape(3, 3).T)[:, 2].min()
        truth.append(min(*others, of_foot, torso.xpos[2] - 0.2))
    assert env.clearance(observation, design).squeeze(-1).numpy() == pytest.approx(truth, abs=1e-9)
    rows = env.rollout(200)
    assert rows["next", "observation"].isfinite().all()
    assert env.clearance(rows["next", "observation"], rows["next", "design"]).min() > -0.05


def test_a_standing_hopper_rises_by_what_its_legs_grow() -> None:
    env = HopperMorph(reset_noise=0.0)
    standing = env.reset()
    longer = torch.tensor([[1.0, 2.0, 1.0, 1.0]])  # a thigh of 0.9 m instead of 0.45 m
    moved = env.transfer(standing["observation"], standing["design"], longer)
    there = env.reset(TensorDict({"design": longer}, [1]))["observation"]
    torch.testing.assert_close(moved, there)
    assert moved[0, 0].item() == pytest.approx(1.25 + 0.45)


@pytest.mark.parametrize("name", [name for name in BODIES if name != "ant"])  # its legs start beyond their ranges
def test_every_body_starts_with_the_clearance_of_the_drawn_one(name: str) -> None:
    env = BODIES[name](num_runs=8, reset_noise=0.0)
    bodies = env.design_spec.expand(8, env.DESIGN_SIZE).rand()
    start = env.reset(TensorDict({"design": bodies}, [8]))
    clearance = env.clearance(start["observation"], bodies)
    torch.testing.assert_close(clearance, clearance[:1].expand(8, 1), atol=1e-6, rtol=0)


def test_both_have_gradients_in_state_and_design() -> None:
    env = WalkerMorph()
    observation, design = (part[:4].requires_grad_() for part in any_poses(env))
    assert torch.autograd.gradcheck(env.clearance, (observation, design))
    other = design.detach().flip(0).requires_grad_()
    assert torch.autograd.gradcheck(env.transfer, (observation, design, other))


def test_batches_of_any_shape_and_one_design_for_many_states() -> None:
    env = HopperMorph()
    observation, design = any_poses(env, 12)
    many = env.clearance(observation.reshape(3, 4, -1), design[0])
    assert many.shape == (3, 4, 1)
    torch.testing.assert_close(many.reshape(12, 1), env.clearance(observation, design[:1].expand(12, -1)))


def test_a_cheetah_of_other_lengths_has_its_own_clearance() -> None:
    printed = HalfCheetahMorph(segment_lengths=(0.29, 0.3, 0.188, 0.29, 0.3, 0.188))
    observation, design = any_poses(printed, 5)
    truth = [lowest_point(printed, row, body) for row, body in zip(observation, design)]
    assert printed.clearance(observation, design).squeeze(-1).numpy() == pytest.approx(truth, abs=1e-12)


def test_lengths_that_are_not_affine_in_the_design_are_refused() -> None:
    def squared(design: np.ndarray) -> mujoco.MjModel:
        env = HopperMorph()
        return env.simulations.body(design**2).compile()

    with pytest.raises(ValueError, match="is not affine in its design"):
        Kinematics(squared, bounds=(0.8, 1.4), size=4)


def test_a_body_that_nothing_moves_up_is_refused() -> None:
    arm = mujoco.MjSpec.from_string(
        "<mujoco><worldbody><body><joint axis='0 1 0'/><geom type='sphere' size='.1'/></body></worldbody></mujoco>"
    )
    with pytest.raises(ValueError, match="neither a free joint nor a vertical slide"):
        Kinematics(lambda design: arm.copy().compile(), bounds=(0.5, 2.0), size=1)


def on_a_root(joints: str, turned: str = "") -> Kinematics:
    """Heights of a torso with a leg, whose root has these joints and is turned like that in the world."""
    robot = mujoco.MjSpec.from_string(
        f"<mujoco><worldbody><body name='torso' pos='0 0 1' {turned}>{joints}<geom type='capsule' fromto='0 0 0 0 0 .3'"
        " size='.05'/><body name='leg'><joint axis='0 1 0'/><geom type='capsule' fromto='0 0 0 0 .1 -.5' size='.04'/>"
        "</body></body></worldbody></mujoco>"
    )
    model = robot.compile()
    found = Kinematics(lambda design: robot.copy().compile(), bounds=(0.5, 2.0), size=1)
    data = mujoco.MjData(model)
    for positions in np.random.default_rng(0).normal(scale=0.7, size=(20, model.nq)):
        data.qpos[:] = positions
        mujoco.mj_kinematics(model, data)
        radius, half = model.geom_size[:, 0], model.geom_size[:, 1]
        lowest = (data.geom_xpos[:, 2] - radius - half * np.abs(data.geom_xmat[:, 8])).min()
        clearance = found.lowest(torch.from_numpy(positions), torch.ones(1, dtype=torch.float64))
        assert clearance.item() == pytest.approx(lowest, abs=1e-9)
    return found


def test_a_root_that_is_turned_rises_along_the_slide_that_is_vertical_in_the_world() -> None:
    assert on_a_root("<joint type='slide' axis='0 0 1'/>").height == 0
    assert on_a_root("<joint type='slide' axis='1 0 0'/>", "euler='0 -90 0'").height == 0
    across = "<joint type='slide' axis='0 0 1'/><joint type='slide' axis='-1 0 0'/><joint axis='0 1 0'/>"
    assert on_a_root(across, "euler='0 90 0'").height == 1


@pytest.mark.parametrize("turned", ["euler='180 0 0'", "euler='0 90 0'", "euler='0 30 0'"])
def test_a_slide_that_is_not_vertical_in_the_world_is_no_height(turned: str) -> None:
    with pytest.raises(ValueError, match="neither a free joint nor a vertical slide"):
        on_a_root("<joint type='slide' axis='0 0 1'/>", turned)


def test_a_slide_behind_a_hinge_is_no_height() -> None:
    with pytest.raises(ValueError, match="a vertical slide that no hinge of the root turns"):
        on_a_root("<joint axis='0 1 0'/><joint type='slide' axis='0 0 1'/>")


def test_designs_of_whole_numbers_are_bodies_too() -> None:
    env = HopperMorph(seed=0)
    state, whole = env.reset()["observation"], torch.ones(1, 4, dtype=torch.int64)
    assert torch.equal(env.clearance(state, whole), env.clearance(state, whole.float()))
    assert torch.equal(env.transfer(state, whole, 2 * whole), env.transfer(state, whole.float(), 2.0 * whole))
