"""Facts about the walker's body and reward. Its lengths, masses and heights are worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from physics_checks import (
    compile_quietly,
    corners_and_random,
    difference_from,
    energy_drift,
    gymnasium_spec,
    mass_error,
    num_contacts,
    reset_to,
    total_mass,
)

from coim.envs import WalkerMorph

UNIFORM = torch.tensor([1.44, 1.85, 1.66, 0.84, 0.95, 1.81, 0.51])
JOINTS_SWAPPED = [0, 1, 2, 6, 7, 8, 3, 4, 5]
MOTORS_SWAPPED = [3, 4, 5, 0, 1, 2]


def bare(num_runs: int = 1) -> WalkerMorph:
    return WalkerMorph(num_runs=num_runs, seed=0, reset_noise=0)


def test_the_unit_body_moves_as_gymnasiums():
    model = compile_quietly(gymnasium_spec("walker2d_v5.xml"))
    assert difference_from(model, bare(), num_steps=200) < 1e-9


def test_another_body_moves_as_gymnasiums_with_its_segments_edited():
    xi = UNIFORM.double().tolist()
    torso = 0.4 * xi[0]
    height = torso / 2 + max(0.45 * xi[1] + 0.6 * xi[2], 0.45 * xi[4] + 0.6 * xi[5])
    spec = gymnasium_spec("walker2d_v5.xml")
    spec.body("torso").pos = [0, 0, height]
    spec.joint("rootx").pos = spec.joint("rootz").pos = [0, 0, -height]
    spec.joint("rootz").ref = height
    spec.geom("torso_geom").size = [0.05, torso / 2, 0]
    for side, first in (("", 1), ("_left", 4)):
        thigh, shank, foot = 0.45 * xi[first], 0.6 * xi[first + 1] - 0.1, 0.2 * xi[first + 2]
        spec.body(f"thigh{side}").pos = [0, 0, -torso / 2]
        spec.geom(f"thigh{side}_geom").pos = [0, 0, -thigh / 2]
        spec.geom(f"thigh{side}_geom").size = [0.05, thigh / 2, 0]
        spec.body(f"leg{side}").pos = [0, 0, -thigh - shank / 2]
        spec.joint(f"leg{side}_joint").pos = [0, 0, shank / 2]
        spec.geom(f"leg{side}_geom").size = [0.04, shank / 2, 0]
        spec.body(f"foot{side}").pos = [foot, 0, -shank / 2 - 0.1]
        spec.joint(f"foot{side}_joint").pos = [-foot, 0, 0.1]
        spec.geom(f"foot{side}_geom").pos = [-foot / 2, 0, 0.1]
        spec.geom(f"foot{side}_geom").size = [0.06, foot / 2, 0]
    env = bare()
    reset_to(env, UNIFORM)
    assert difference_from(compile_quietly(spec), env, num_steps=50) < 1e-11


@pytest.mark.parametrize(("scale", "kilograms", "height"), [(0.5, 13.294, 0.625), (1, 23.677, 1.25), (2, 44.443, 2.5)])
def test_mass_and_start_height_follow_the_lengths(scale, kilograms, height):
    env = bare()
    observation = reset_to(env, torch.full((7,), float(scale)))["observation"]
    assert total_mass(env) == pytest.approx(kilograms, abs=5e-4)
    assert observation[0, 1].item() == pytest.approx(height, abs=1e-6)
    assert mass_error(env) < 2e-15


def test_left_and_right_are_mirror_images():
    env = bare(2)
    mirrored = UNIFORM[[0, 4, 5, 6, 1, 2, 3]]
    reset_to(env, torch.stack([UNIFORM, mirrored]))
    generator = torch.Generator().manual_seed(0)
    for _ in range(60):
        action = 2 * torch.rand(6, generator=generator) - 1
        env.advance(torch.stack([action, action[MOTORS_SWAPPED]]))
    qpos, qvel = env.simulations.qpos, env.simulations.qvel
    assert np.abs(qpos[0] - qpos[1][JOINTS_SWAPPED]).max() < 1e-10
    assert np.abs(qvel[0] - qvel[1][JOINTS_SWAPPED]).max() < 1e-9


def test_nothing_touches_at_a_bare_start_whatever_the_design():
    designs = corners_and_random(WalkerMorph, 64)
    env = bare(len(designs))
    reset_to(env, designs)
    assert len(designs) == 2**7 + 64
    assert num_contacts(env) == 0


def test_the_soles_of_the_longer_leg_start_4_cm_above_the_floor():
    env = bare()
    reset_to(env, UNIFORM)
    env.simulations.qpos[0, 1] -= 0.05
    env.simulations.lift_out_of_floor(0)
    lowest_start = env.simulations.model(0).qpos0[1] - 0.04
    assert env.simulations.qpos[0, 1] == pytest.approx(lowest_start, abs=1e-12)


def test_free_flight_keeps_the_energy():
    env = bare()
    reset_to(env, UNIFORM)
    assert energy_drift(env, 200) < 1e-9


@pytest.mark.parametrize(
    ("height", "velocity", "pitch", "task", "reward"),
    [
        (1.2, 2.0, 0.0, "forward", 0.3),
        (1.2, -2.0, 0.0, "forward", 0.1),
        (1.2, -2.0, 0.0, "backward", 0.3),
        (0.81, 2.0, 0.0, "forward", 0.3),
        (0.79, 2.0, 0.0, "forward", 0.0),
        (1.2, 2.0, -0.5, "forward", 0.295),
        (0.7, 2.0, math.pi, "forward", -0.01 * math.pi),
        (0.7, 2.0, 2 * math.pi + 0.5, "forward", -0.005),  # a pitch that winds up costs no more than its direction
    ],
)
@pytest.mark.parametrize("root_x", [[], [3.0]], ids=["17", "18"])
def test_reward_as_printed(root_x, height, velocity, pitch, task, reward):
    next_observation = torch.tensor([[*root_x, height, pitch, *[0.3] * 6, velocity, *[0.2] * 8]])
    got = WalkerMorph.reward(next_observation, torch.zeros(1, 6), next_observation, torch.ones(1, 7), task)
    assert got.shape == (1, 1)
    assert got.item() == pytest.approx(reward, abs=1e-6)


def test_observation_holds_the_distance_unless_told_not_to():
    torch.manual_seed(0)
    with_x, without = WalkerMorph(seed=3), WalkerMorph(seed=3, observe_root_x=False)
    a, b = with_x.reset()["observation"], without.reset()["observation"]
    assert a.shape == (1, 18)
    assert b.shape == (1, 17)
    torch.testing.assert_close(a[:, 1:], b, rtol=0, atol=0)
    assert (with_x.angle_indices, without.angle_indices) == ((2,), (1,))
    action = torch.full((1, 6), 0.4)
    assert with_x.advance(action)[1].item() == without.advance(action)[1].item()


def test_the_first_designs_can_be_built():
    designs = torch.tensor(WalkerMorph.FIRST_DESIGNS)
    assert designs.shape == (5, 7)
    reset_to(bare(5), designs)
