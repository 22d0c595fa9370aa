"""Pairs of a state and a body that cannot be, and the rows that are taken in their place.  N rows, K runs."""

from __future__ import annotations

import pytest
import torch

from coim.envs import BODIES, HopperMorph
from coim.episode import run_episode
from coim.pairs import IN_THE_FLOOR, impossible_pairs, stand_ins


def test_a_pair_is_impossible_where_more_than_the_tolerance_is_in_the_floor() -> None:
    env = HopperMorph()
    depths = torch.tensor([-0.04, 0.0, 0.99 * IN_THE_FLOOR, 1.01 * IN_THE_FLOOR, 1.0])  # the soles start 4 cm above it
    standing = torch.zeros(5, 11)
    standing[:, 0] = 1.25 - 0.04 - depths
    found = impossible_pairs(env.clearance, standing, torch.ones(5, 4))
    assert found.tolist() == [False, False, False, True, True]


@pytest.mark.parametrize("name", BODIES)
def test_hardly_any_state_that_a_body_gets_into_by_itself_counts_as_impossible(name: str) -> None:
    env = BODIES[name](num_runs=32, episode_steps=200, seed=0)
    bodies = torch.stack([env.design_spec.rand() for _ in range(32)])
    rows = run_episode(env, None, design=bodies, rng=torch.Generator().manual_seed(0))  # random actions
    assert impossible_pairs(env.clearance, rows["observation"], rows["design"]).float().mean() < 0.01


def test_a_usable_row_stays_and_the_others_take_usable_ones_of_their_run_in_turn() -> None:
    usable = torch.tensor([[True, False], [False, False], [True, True], [False, False], [False, True]])
    taken = stand_ins(usable)
    assert taken[:, 0].tolist() == [0, 0, 2, 2, 0]
    assert taken[:, 1].tolist() == [2, 4, 2, 2, 4]
    assert torch.equal(taken[:, 1], stand_ins(usable[:, 1]))


def test_all_usable_rows_stand_in_before_one_does_so_again() -> None:
    usable = torch.tensor([False, True, False, True, False, True, False])
    assert stand_ins(usable).tolist() == [1, 1, 3, 3, 5, 5, 1]


def test_a_run_without_a_usable_row_is_named() -> None:
    with pytest.raises(ValueError, match="none of the 3 rows of a run can be used"):
        stand_ins(torch.tensor([[True, False]] * 3))
