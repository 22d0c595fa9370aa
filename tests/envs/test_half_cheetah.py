"""Facts about the cheetah's body and reward. Its lengths, masses and heights are worked out by hand."""

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

from coim.envs import HalfCheetahMorph

UNIFORM = torch.tensor([1.41, 0.96, 1.97, 1.73, 1.97, 1.17])

# Of the drawn body: geom, its position and half length, and where the next segment hangs.
SEGMENTS = (
    ("bthigh", (0.1, 0, -0.13), 0.145, "bshin", (0.16, 0, -0.25)),
    ("bshin", (-0.14, 0, -0.07), 0.15, "bfoot", (-0.28, 0, -0.14)),
    ("bfoot", (0.03, 0, -0.097), 0.094, None, None),
    ("fthigh", (-0.07, 0, -0.12), 0.133, "fshin", (-0.14, 0, -0.24)),
    ("fshin", (0.065, 0, -0.09), 0.106, "ffoot", (0.13, 0, -0.18)),
    ("ffoot", (0.045, 0, -0.07), 0.07, None, None),
)


def bare(num_runs: int = 1) -> HalfCheetahMorph:
    return HalfCheetahMorph(num_runs=num_runs, seed=0, reset_noise=0)


def test_the_unit_body_moves_as_gymnasiums():
    model = compile_quietly(gymnasium_spec("half_cheetah.xml"))
    assert difference_from(model, bare(), num_steps=5) < 1e-11
    assert (
        difference_from(model, bare(), num_steps=25) < 1e-9
    )  # contacts make it chaotic: rounding grows tenfold every few steps


def test_another_body_moves_as_gymnasiums_with_its_segments_edited():
    env = bare()
    reset_to(env, UNIFORM)
    spec = gymnasium_spec("half_cheetah.xml")
    spec.compiler.settotalmass = -1
    for geom in spec.geoms:
        geom.density = 660.8849500774736
    for scale, (name, position, half_length, child, hangs) in zip(UNIFORM.double().tolist(), SEGMENTS):
        spec.geom(name).pos = np.multiply(position, scale)
        spec.geom(name).size = [0.046, half_length * scale, 0]
        if child is not None:
            spec.body(child).pos = np.multiply(hangs, scale)
    spec.body("torso").pos = [0, 0, env.simulations.model(0).body("torso").pos[2]]
    assert difference_from(compile_quietly(spec), env, num_steps=10) < 1e-12


@pytest.mark.parametrize(
    ("scale", "kilograms", "height"), [(0.8, 12.773, 0.584), (1.0, 14.0, 0.7), (2.0, 20.133, 1.278)]
)
def test_mass_and_start_height_follow_the_legs(scale, kilograms, height):
    env = bare()
    reset_to(env, torch.full((6,), scale))
    assert total_mass(env) == pytest.approx(kilograms, abs=5e-4)
    assert env.simulations.model(0).body("torso").pos[2] == pytest.approx(height, abs=5e-4)
    assert mass_error(env) < 2e-15


def test_longer_legs_do_not_drain_the_torso():
    env = bare(2)
    reset_to(env, torch.tensor([[1.0] * 6, [2.0] * 6]))
    unit, long = (env.simulations.model(row).body("torso").mass for row in range(2))
    assert unit == long


def test_no_foot_touches_the_floor_at_a_bare_start_whatever_the_design():
    designs = corners_and_random(HalfCheetahMorph, 64)
    env = bare(len(designs))
    reset_to(env, designs)
    assert num_contacts(env) == 0


def test_reset_noise_never_starts_a_foot_in_the_floor():
    env = HalfCheetahMorph(num_runs=64, seed=0)
    env.reset()
    lifted = env.simulations.qpos.copy()
    for row in range(64):
        env.simulations.qpos[row, 1] -= 1e-6
        env.simulations.lift_out_of_floor(row)
    stand_on_floor = np.abs(env.simulations.qpos - lifted).max(1) < 1e-12
    fly = np.abs(lifted[:, 1] - env.simulations.qpos[:, 1] - 1e-6) < 1e-12
    assert (stand_on_floor | fly).all()
    assert 0.05 < stand_on_floor.mean() < 0.35  # about one in six starts in the floor without the lift


def test_reset_noise_is_uniform_in_position_and_normal_in_velocity():
    env = HalfCheetahMorph(num_runs=300, seed=0)
    env.reset()
    joints, velocities = env.simulations.qpos[:, 2:], env.simulations.qvel
    assert np.abs(joints).max() <= 0.1
    assert joints.std() == pytest.approx(0.1 / math.sqrt(3), rel=0.05)
    assert np.abs(velocities).max() > 0.2
    assert velocities.std() == pytest.approx(0.1, rel=0.05)


def test_free_flight_keeps_the_energy_but_for_the_springs():
    env = bare()
    reset_to(env, UNIFORM)
    assert energy_drift(env, 200) < 1e-9


def test_segment_lengths_takes_the_printed_front_leg():
    printed = HalfCheetahMorph(segment_lengths=(0.29, 0.3, 0.188, 0.29, 0.3, 0.188))
    model = printed.simulations.model(0)
    assert [float(model.geom(name).size[1]) for name in ("fthigh", "fshin", "ffoot")] == pytest.approx(
        [0.145, 0.15, 0.094]
    )
    assert float(model.geom("bthigh").size[1]) == 0.145


@pytest.mark.parametrize("lengths", [(0.3,) * 5, (0.3,) * 5 + (0.0,), (0.3,) * 5 + (math.nan,)])
def test_segment_lengths_that_are_none_get_a_sentence(lengths):
    with pytest.raises(ValueError, match="not six lengths in m"):
        HalfCheetahMorph(segment_lengths=lengths)


@pytest.mark.parametrize(
    ("velocity", "task", "reward"),
    [
        (3.0, "forward", 0.3),
        (-3.0, "forward", 0.0),
        (-3.0, "backward", 0.3),
        (3.0, "backward", 0.0),
        (200.0, "forward", 10.0),
    ],
)
def test_reward_is_a_tenth_of_the_speed_between_0_and_10(velocity, task, reward):
    next_observation = torch.zeros(2, 17)
    next_observation[:, 8] = velocity
    got = HalfCheetahMorph.reward(torch.zeros(2, 17), torch.zeros(2, 6), next_observation, torch.ones(2, 6), task)
    assert got.shape == (2, 1)
    assert got.flatten().tolist() == pytest.approx([reward] * 2)


def test_observation_is_height_pitch_joints_and_all_velocities():
    env = HalfCheetahMorph(seed=0)
    observation = env.reset()["observation"][0].double().numpy()
    qpos, qvel = env.simulations.qpos[0], env.simulations.qvel[0]
    np.testing.assert_allclose(observation, np.concatenate([qpos[1:], qvel]), rtol=1e-6)
    assert env.angle_indices == (1,)


def test_the_first_designs_can_be_built():
    designs = torch.tensor(HalfCheetahMorph.FIRST_DESIGNS)
    assert designs.shape == (5, 6)
    reset_to(bare(5), designs)
