"""Rows of a fleet: seeds, saved states, places, and simulations that break."""

from __future__ import annotations

import math

import pytest
import torch
from morph_cases import BODIES, some_actions, some_designs
from physics_checks import reset_to
from tensordict import TensorDict

from coim.envs import HopperMorph


def test_episodes_are_truncated_row_by_row_and_never_terminated_by_a_fall():
    env = HopperMorph(num_runs=2, seed=0, episode_steps=6)
    td = env.reset()
    truncated = []
    for i, action in enumerate(some_actions(env, 8)):
        if i == 2:
            td["_reset"] = torch.tensor([[True], [False]])
            td = env.reset(td)
        td = env.step(td.set("action", action))["next"].exclude("reward")
        truncated.append(td["truncated"].flatten().tolist())
        assert not td["terminated"].any()
        assert td["done"].equal(td["truncated"])
    assert truncated == [[False, False]] * 5 + [[False, True]] * 2 + [[True, True]]


@BODIES
def test_the_same_seed_gives_the_same_bits_and_rows_differ(body):
    def play(seed: int) -> torch.Tensor:
        env = body(num_runs=2, seed=seed)
        env.reset()
        return torch.stack([env.advance(action)[0] for action in some_actions(env, 10)])

    first = play(1)
    assert first.equal(play(1))
    assert not first.equal(play(2))
    assert not first[:, 0].equal(first[:, 1])


@BODIES
def test_no_two_rows_of_any_seeds_start_alike(body):
    starts = torch.cat([body(num_runs=3, seed=seed).reset()["observation"] for seed in range(3)])
    assert len(starts.unique(dim=0)) == 9


def test_set_seed_begins_the_noise_anew():
    env = HopperMorph(num_runs=2, seed=0)
    first, second = env.reset()["observation"], env.reset()["observation"]
    env.set_seed(0)
    assert env.reset()["observation"].equal(first)
    assert not first.equal(second)


def test_without_a_seed_torchs_own_decides():
    torch.manual_seed(5)
    a = HopperMorph().reset()["observation"]
    b = HopperMorph().reset()["observation"]
    torch.manual_seed(5)
    assert HopperMorph().reset()["observation"].equal(a)
    assert not a.equal(b)


@BODIES
def test_a_row_of_a_fleet_is_the_row_alone(body):
    fleet = body(num_runs=5, seed=0, num_threads=2)
    reset_to(fleet, some_designs(fleet))
    alone = body(num_runs=1, seed=99)
    alone.set_simulation_state(fleet.get_simulation_state()[3:4])
    for i, action in enumerate(some_actions(fleet, 40)):
        if i == 20:
            assert fleet.reset()["observation"][3:4].equal(alone.reset()["observation"])
        in_fleet, by_itself = fleet.advance(action), alone.advance(action[3:4])
        for a, b in zip(in_fleet, by_itself):
            assert a[3:4].equal(b)


@BODIES
def test_an_episode_goes_on_from_a_saved_state_to_the_last_bit(body, tmp_path):
    env = body(num_runs=2, seed=0, episode_steps=30)
    reset_to(env, some_designs(env))
    actions = some_actions(env, 40)
    for action in actions[:20]:
        env.advance(action)
    torch.save(env.get_simulation_state(), tmp_path / "state.pt")
    resumed = body(num_runs=2, seed=7, episode_steps=30)
    resumed.set_simulation_state(torch.load(tmp_path / "state.pt", weights_only=False))
    for i, action in enumerate(actions[20:]):
        a, b = (e.step(TensorDict({"action": action}, [2]))["next"] for e in (env, resumed))
        assert (a == b).all()
        assert a["truncated"].all().item() == (i >= 9)
    assert (env.reset() == resumed.reset()).all()


@BODIES
@pytest.mark.parametrize("velocity", [math.nan, 1e12])
def test_a_broken_row_is_terminated_counted_finite_and_alone(body, velocity):
    sound, env = body(num_runs=3, seed=0), body(num_runs=3, seed=0)
    before, _ = sound.reset()["observation"], env.reset()
    env.simulations.qvel[1, 0] = velocity
    action = some_actions(env, 1)[0]
    expected, got = sound.advance(action), env.advance(action)
    observation, reward, terminated = got
    assert terminated.flatten().tolist() == [False, True, False]
    assert env.num_broken.tolist() == [0, 1, 0]
    assert observation[1].equal(before[1])  # its last finite one
    assert reward.isfinite().all()
    for a, b in zip(expected, got):
        assert a[[0, 2]].equal(b[[0, 2]])
    env.reset(TensorDict({"_reset": torch.tensor([[False], [True], [False]])}, [3]))
    for action in some_actions(env, 5, seed=1):
        observation, reward, terminated = env.advance(action)
        assert not terminated.any()
        assert observation[[0, 2]].equal(sound.advance(action)[0][[0, 2]])
    assert env.num_broken.tolist() == [0, 1, 0]


def test_every_break_is_counted_and_answered_with_the_last_observation_of_the_row_itself():
    env = HopperMorph(num_runs=2, seed=0)
    env.reset()
    for times, action in enumerate(some_actions(env, 3), start=1):
        observation, _, _ = env.advance(action)
        seen = observation.clone()
        observation.zero_()  # it is the caller's own
        env.simulations.qvel[0, 0] = math.nan
        broken, _, _ = env.advance(action)
        assert broken[0].equal(seen[0])
        assert env.num_broken.tolist() == [times, 0]
        env.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, [2]))


def test_a_rollout_goes_on_after_a_broken_row():
    env = HopperMorph(num_runs=2, seed=0)
    designs = some_designs(env)
    td = reset_to(env, designs)
    env.simulations.qvel[0, 2] = math.inf
    td = env.rollout(6, auto_reset=False, tensordict=td, break_when_any_done=False)
    assert td["next", "terminated"].squeeze(-1).tolist() == [[True] + [False] * 5, [False] * 6]
    assert td["next", "observation"].isfinite().all()
    assert td["design"].equal(designs[:, None].expand(2, 6, -1))


@BODIES
def test_place_takes_up_a_trajectory_at_any_step(body):
    env, oracle = body(num_runs=2, seed=0), body(num_runs=2, seed=1)
    observation = reset_to(env, some_designs(env))["observation"]
    for action in some_actions(env, 30):
        oracle.place(observation, env.get_simulation_state()["design"])
        observation, reward, _ = env.advance(action)
        predicted, predicted_reward, _ = oracle.advance(action)
        torch.testing.assert_close(predicted, observation, rtol=1e-3, atol=2e-3)
        torch.testing.assert_close(predicted_reward, reward, rtol=1e-3, atol=1e-3)


def test_place_begins_a_new_count_of_steps():
    env = HopperMorph(num_runs=1, seed=0, episode_steps=3)
    td = env.reset()
    for action in some_actions(env, 2):
        td = env.step(td.set("action", action))["next"].exclude("reward")
    env.place(td["observation"], td["design"])
    truncated = [env.step(td.set("action", action))["next", "truncated"].item() for action in some_actions(env, 3)]
    assert truncated == [False, False, True]


def test_a_broken_row_leaves_no_file_behind(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env = HopperMorph(seed=0)
    env.reset()
    env.simulations.qvel[0] = math.nan
    env.advance(torch.zeros(1, 3))
    assert list(tmp_path.iterdir()) == []
