"""Facts about the ant's body and reward: Gymnasium's at xi = 1, and longer legs that stay out of the floor."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch
from physics_checks import GYMNASIUM_ASSETS, difference_from, mass_error, num_contacts, reset_to, total_mass

from coim import morph_from_mjcf
from coim.envs import AntMorph, MorphEnv

PAIRS = {
    f"{end} {part}": [f"{end}_{side}_{part}" for side in ("left", "right")]
    for end in ("front", "back")
    for part in ("thigh", "shin")
}


def bare(num_runs: int = 1) -> AntMorph:
    return AntMorph(num_runs=num_runs, seed=0, reset_noise=0)


def some_designs(count: int) -> torch.Tensor:
    uniform = torch.rand(count, 8, generator=torch.Generator().manual_seed(0))
    return torch.cat([torch.full((1, 8), 0.5), torch.full((1, 8), 1.5), 0.5 + uniform])


def gymnasiums() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(GYMNASIUM_ASSETS / "ant.xml"))


def test_the_unit_body_moves_as_gymnasiums() -> None:
    assert difference_from(gymnasiums(), bare(), num_steps=20) == 0


def test_mass_follows_length_and_the_torso_keeps_its_own() -> None:
    env = bare(2)
    reset_to(env, torch.tensor([[1.5] * 8, [1.0] * 8]))
    long, unit = (env.simulations.model(row) for row in range(2))
    assert np.array_equal(unit.body_mass, gymnasiums().body_mass)
    assert long.body("torso").mass == unit.body("torso").mass
    radius, longer = 0.08, 0.5 * 4 * (0.2 + 0.4) * math.sqrt(2)  # m
    assert total_mass(env) - unit.body_mass.sum() == pytest.approx(5 * math.pi * radius**2 * longer)


def test_mass_is_density_times_volume() -> None:
    env = bare()
    reset_to(env, some_designs(1)[2])
    assert mass_error(env) < 1e-14


def test_nothing_touches_the_floor_at_a_bare_start_whatever_the_design() -> None:
    designs = some_designs(10)
    env = bare(len(designs))
    reset_to(env, designs)
    assert num_contacts(env) == 0


def test_legs_driven_into_their_ranges_end_as_high_as_the_drawn_ones() -> None:
    designs = torch.cat([torch.ones(1, 8), some_designs(5)])
    env = bare(len(designs))
    start = reset_to(env, designs)["observation"].clone()
    ankles = torch.tensor([30.0, -30.0, -30.0, 30.0]).deg2rad()
    start[:, 6:13:2] = ankles
    clearance = 0.75 - 0.4 * math.sqrt(2) * math.sin(math.pi / 6) - 0.08
    torch.testing.assert_close(env.clearance(start, designs), torch.full((len(designs), 1), clearance))


def test_a_noisy_start_is_upright_enough_on_the_floor_with_a_unit_quaternion() -> None:
    env = AntMorph(num_runs=16, seed=0)
    observation = reset_to(env, torch.full((8,), 1.5))["observation"]
    assert min(env.simulations.lowest_point(row) for row in range(16)) > -1e-9
    torch.testing.assert_close(observation[:, 1:5].norm(dim=-1), torch.ones(16))
    assert observation.shape == (16, 27)
    assert (env.angle_indices, env.quaternion_index) == ((), 1)


@pytest.mark.parametrize(
    ("height", "speed", "action", "task", "reward"),
    [
        (0.6, 2.0, 0.5, "forward", 2.0 + 1.0 - 0.5 * 8 * 0.25),
        (0.6, 2.0, 0.5, "backward", -2.0 + 1.0 - 1.0),
        (0.1, 2.0, 0.0, "forward", 2.0),
        (1.1, 2.0, 0.0, "forward", 2.0),
    ],
)
def test_the_reward_is_gymnasiums_without_contact_forces(
    height: float, speed: float, action: float, task: str, reward: float
) -> None:
    following = torch.zeros(2, 27)
    following[:, 0], following[:, 13] = height, speed
    got = AntMorph.reward(torch.zeros(2, 27), torch.full((2, 8), action), following, torch.ones(2, 8), task)
    assert got.flatten().tolist() == pytest.approx([reward] * 2)


def test_four_pairs_of_legs_are_one_line_from_the_same_file() -> None:
    import coim.envs.ant as home

    file = home.__file__.replace("ant.py", "assets/ant.xml")
    body: type[MorphEnv] = morph_from_mjcf(file, PAIRS, AntMorph.reward, bounds=(0.5, 1.5), frame_skip=5)
    pairs, own = body(reset_noise=0), bare()
    reset_to(pairs, torch.tensor([1.2, 0.7, 0.8, 1.4]))
    reset_to(own, torch.tensor([1.2, 0.7, 0.8, 1.4, 0.8, 1.4, 1.2, 0.7]))
    assert np.array_equal(pairs.simulations.model(0).body_mass, own.simulations.model(0).body_mass)
    assert np.array_equal(pairs.simulations.model(0).body_pos, own.simulations.model(0).body_pos)


def test_the_first_designs_can_be_built() -> None:
    designs = torch.tensor(AntMorph.FIRST_DESIGNS)
    assert designs.shape == (5, 8)
    reset_to(bare(5), designs)
