"""Facts about the hopper's body and reward. Its lengths, masses and heights are worked out by hand."""

from __future__ import annotations

import math

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

from coim.envs import HopperMorph

UNIFORM = torch.tensor([1.91, 1.27, 0.96, 0.62])


def bare(num_runs: int = 1) -> HopperMorph:
    return HopperMorph(num_runs=num_runs, seed=0, reset_noise=0)


def test_the_unit_body_moves_as_gymnasiums():
    model = compile_quietly(gymnasium_spec("hopper.xml"))
    assert difference_from(model, bare(), num_steps=200) < 1e-11


def test_another_body_moves_as_gymnasiums_with_its_segments_edited():
    xi = UNIFORM.double().tolist()
    torso, thigh, shank, foot = 0.4 * xi[0], 0.45 * xi[1], 0.5 * xi[2], 0.39 * xi[3]
    height = torso / 2 + thigh + shank + 0.1
    spec = gymnasium_spec("hopper.xml")
    spec.body("torso").pos = [0, 0, height]
    spec.joint("rootx").pos = spec.joint("rootz").pos = [0, 0, -height]
    spec.joint("rootz").ref = height
    spec.geom("torso_geom").size = [0.05, torso / 2, 0]
    spec.body("thigh").pos = [0, 0, -torso / 2]
    spec.geom("thigh_geom").pos = [0, 0, -thigh / 2]
    spec.geom("thigh_geom").size = [0.05, thigh / 2, 0]
    spec.body("leg").pos = [0, 0, -thigh - shank / 2]
    spec.joint("leg_joint").pos = [0, 0, shank / 2]
    spec.geom("leg_geom").size = [0.04, shank / 2, 0]
    spec.body("foot").pos = [foot / 3, 0, -shank / 2 - 0.1]
    spec.joint("foot_joint").pos = [-foot / 3, 0, 0.1]
    spec.geom("foot_geom").pos = [-foot / 6, 0, 0.1]
    spec.geom("foot_geom").size = [0.06, foot / 2, 0]
    env = bare()
    reset_to(env, UNIFORM)
    assert difference_from(compile_quietly(spec), env, num_steps=50) < 1e-11


@pytest.mark.parametrize(("scale", "kilograms", "height"), [(0.5, 9.020, 0.675), (1, 15.820, 1.25), (2, 29.420, 2.4)])
def test_mass_and_start_height_follow_the_lengths(scale, kilograms, height):
    env = bare()
    observation = reset_to(env, torch.full((4,), float(scale)))["observation"]
    assert total_mass(env) == pytest.approx(kilograms, abs=5e-4)
    assert observation[0, 0].item() == pytest.approx(height, abs=1e-6)
    assert mass_error(env) < 2e-15


def test_nothing_touches_at_a_bare_start_whatever_the_design():
    designs = corners_and_random(HopperMorph, 64)
    env = bare(len(designs))
    reset_to(env, designs)
    assert num_contacts(env) == 0


def test_free_flight_keeps_the_energy():
    env = bare()
    reset_to(env, UNIFORM)
    assert energy_drift(env, 200) < 1e-9


@pytest.mark.parametrize(
    ("height", "velocity", "pitch", "task", "reward"),
    [
        (1.2, 2.0, 0.0, "forward", 3.0),
        (1.2, -2.0, 0.0, "forward", 1.0),
        (1.2, -2.0, 0.0, "backward", 3.0),
        (0.51, 2.0, 0.0, "forward", 3.0),
        (0.49, 2.0, 0.0, "forward", 0.3),
        (1.2, 2.0, -0.5, "forward", 2.95),
        (0.4, 0.0, math.pi, "forward", 0.1 - 0.1 * math.pi),
        (0.4, 0.0, 4 * math.pi - 0.5, "forward", 0.05),  # a pitch that winds up costs no more than its direction
    ],
)
def test_reward_as_printed(height, velocity, pitch, task, reward):
    next_observation = torch.tensor([[height, pitch, *[0.3] * 3, velocity, *[0.2] * 5]])
    got = HopperMorph.reward(next_observation, torch.zeros(1, 3), next_observation, torch.ones(1, 4), task)
    assert got.shape == (1, 1)
    assert got.item() == pytest.approx(reward, abs=1e-6)


def test_observation_is_height_pitch_joints_and_all_velocities():
    env = bare()
    assert env.reset()["observation"].tolist() == [[1.25] + [0.0] * 10]
    assert env.angle_indices == (1,)


def test_the_first_designs_can_be_built():
    designs = torch.tensor(HopperMorph.FIRST_DESIGNS)
    assert designs.shape == (5, 4)
    reset_to(bare(5), designs)
