"""The environment as TorchRL sees it: specs, designs through resets and transforms, names, devices."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from morph_cases import BODIES, some_actions, some_designs
from physics_checks import reset_to
from tensordict import TensorDict
from torchrl.envs import Compose, RewardSum, SerialEnv, StepCounter, TransformedEnv, check_env_specs
from torchrl.envs.utils import RandomPolicy

from coim.envs import HalfCheetahMorph, HopperMorph, WalkerMorph

SIZES = {HalfCheetahMorph: (17, 6, 6), WalkerMorph: (18, 7, 6), HopperMorph: (11, 4, 3)}  # S, D, A


# ---- TorchRL ----


@BODIES
@pytest.mark.parametrize("num_runs", [1, 3])
def test_specs_hold(body, num_runs):
    env = body(num_runs=num_runs, seed=0)
    check_env_specs(env)
    assert env.batch_size == (num_runs,)
    sizes = tuple(spec.shape[-1] for spec in (env.observation_spec["observation"], env.design_spec, env.action_spec))
    assert sizes == SIZES[body]
    assert env.state_spec["design"].shape == env.observation_spec["design"].shape == (num_runs, sizes[1])


@BODIES
def test_design_spec_clips_and_draws(body):
    spec = body().design_spec
    low, high = body.DESIGN_BOUNDS
    assert spec.shape == (body.DESIGN_SIZE,)
    clipped = spec.project(torch.full((5, body.DESIGN_SIZE), 9.0))
    assert clipped.tolist() == [[high] * body.DESIGN_SIZE] * 5
    drawn = spec.rand((100,))
    assert low <= drawn.min() < drawn.max() <= high


@BODIES
def test_a_rollout_carries_the_design_in_every_row(body):
    env = body(num_runs=2, seed=0)
    designs = some_designs(env)
    start = env.reset(TensorDict({"design": designs}, [2]))
    td = env.rollout(4, auto_reset=False, tensordict=start)
    assert td["design"].equal(designs[:, None].expand(2, 4, -1))
    assert td["next", "design"].equal(td["design"])
    assert not td["next", "done"].any()


@BODIES
def test_step_and_advance_are_the_same(body):
    stepped, advanced = body(num_runs=2, seed=0), body(num_runs=2, seed=0)
    td = stepped.reset()
    advanced.reset()
    for action in some_actions(stepped, 5):
        td = stepped.step(td.set("action", action))["next"].exclude("reward")
        observation, _, _ = advanced.advance(action)
        assert td["observation"].equal(observation)


@BODIES
def test_the_dreams_reward_agrees_with_the_worlds_to_the_last_bit(body):
    env = body(num_runs=3, seed=0, task="backward")
    td = env.rollout(50)
    again = env.reward_fn(td["observation"], td["action"], td["next", "observation"], td["design"])
    assert again.equal(td["next", "reward"])
    assert (again != 0).any()


def test_a_transformed_env_takes_designs_and_keeps_them():
    env = TransformedEnv(HopperMorph(num_runs=2, seed=0, episode_steps=3), Compose(StepCounter(), RewardSum()))
    check_env_specs(env)
    designs = some_designs(env.base_env)
    td = env.rollout(
        8, auto_reset=False, tensordict=env.reset(TensorDict({"design": designs}, [2])), break_when_any_done=False
    )
    assert td["design"].equal(designs[:, None].expand(2, 8, -1))
    assert td["next", "truncated"].squeeze(-1).tolist() == [[False, False, True] * 2 + [False, False]] * 2


def test_a_serial_env_takes_designs_and_keeps_them():
    env = SerialEnv(2, lambda: HopperMorph(num_runs=3, seed=0, episode_steps=3))
    designs = torch.stack([torch.full((3, 4), 0.8), torch.full((3, 4), 1.2)])
    td = env.rollout(
        5, auto_reset=False, tensordict=env.reset(TensorDict({"design": designs}, [2, 3])), break_when_any_done=False
    )
    assert td["design"].equal(designs[:, :, None].expand(2, 3, 5, -1))
    heights = td["observation"][:, 0, 0, 0]
    assert heights.tolist() == pytest.approx([0.8 * 1.15 + 0.1, 1.2 * 1.15 + 0.1], abs=0.006)
    env.close()


@pytest.mark.filterwarnings("ignore:Creating .*WeightUpdater:DeprecationWarning")  # torchrl's own import
def test_a_collector_keeps_the_designs_across_episodes():
    from torchrl.collectors import Collector

    env = HopperMorph(num_runs=2, seed=0, episode_steps=4)
    designs = some_designs(env)
    reset_to(env, designs)
    collector = Collector(env, RandomPolicy(env.action_spec), frames_per_batch=20, total_frames=40)
    batches = [batch.clone() for batch in collector]
    collector.shutdown()
    assert len(batches) == 2
    for batch in batches:
        assert batch["design"].equal(designs[:, None].expand(2, 10, -1))
        assert batch["next", "design"].equal(batch["design"])
    assert batches[0]["next", "truncated"][0].squeeze(-1).tolist() == [False, False, False, True] * 2 + [False, False]


# ---- resets ----


def test_the_first_body_is_the_unit_body_and_a_reset_without_design_keeps_the_last():
    env = HopperMorph(num_runs=2, seed=0)
    assert env.reset()["design"].tolist() == [[1.0] * 4] * 2
    designs = some_designs(env)
    reset_to(env, designs)
    assert env.reset()["design"].equal(designs)


def test_a_partial_reset_answers_with_the_other_rows_as_they_are():
    env = HopperMorph(num_runs=3, seed=0)
    designs = some_designs(env)
    reset_to(env, designs)
    for action in some_actions(env, 5):
        observation, _, _ = env.advance(action)
    wanted = torch.full((3, 4), 1.5)
    td = env.reset(TensorDict({"_reset": torch.tensor([[False], [True], [False]]), "design": wanted}, [3]))
    assert td["design"][[0, 2]].equal(designs[[0, 2]])
    assert td["design"][1].equal(wanted[1])
    assert td["observation"][[0, 2]].equal(observation[[0, 2]])
    assert td["observation"][1, 0].item() == pytest.approx(1.5 * 1.15 + 0.1, abs=0.006)


def test_a_partial_reset_disturbs_no_other_row():
    whole, partial = HopperMorph(num_runs=2, seed=0), HopperMorph(num_runs=2, seed=0)
    whole.reset(), partial.reset()
    actions = some_actions(whole, 10)
    for i, action in enumerate(actions):
        if i == 5:
            partial.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, [2]))
        a, b = whole.advance(action)[0], partial.advance(action)[0]
        assert a[1].equal(b[1])
    assert not a[0].equal(b[0])


def test_a_fallen_robot_goes_on_with_its_pitch_wrapped():
    env = HopperMorph(num_runs=8, seed=0)
    env.reset()
    highest = 0.0
    for action in some_actions(env, 400):
        observation, _, terminated = env.advance(action)
        assert not terminated.any()
        highest = max(highest, observation[:, 1].abs().max().item())
    assert highest <= np.float32(math.pi)
    assert np.abs(env.simulations.qpos[:, 2]).max() > 4  # the hinge itself has gone on turning


def test_capsules_show_the_body_of_the_row():
    env = HopperMorph(num_runs=2, reset_noise=0)
    reset_to(env, torch.tensor([[1.0] * 4, [2.0] * 4]))
    unit, tall = (env.capsules(run) for run in range(2))
    assert unit.shape == tall.shape == (4, 7)  # torso, thigh, leg, foot
    assert unit[:, [2, 5]].max().item() == pytest.approx(1.25 + 0.2)
    assert tall[:, [2, 5]].max().item() == pytest.approx(2.4 + 0.4)


# ---- bad input ----


def test_counts_may_be_numpys():
    class Skipping(HopperMorph):
        FRAME_SKIP = np.int64(2)

    env = Skipping(num_runs=np.int64(2), episode_steps=np.int64(3), num_threads=np.int64(2))
    assert env.rollout(5).shape == (2, 3)


@BODIES
def test_each_entry_of_a_design_has_a_name_from_the_bodys_table(body):
    names = body.design_names()
    assert len(names) == body().design_spec.shape[0]
    assert all(word in body.__doc__ for name in names for word in name.split())


def test_without_names_the_entries_are_counted():
    class Nameless(HopperMorph):
        DESIGN_NAMES = ()

    Nameless()
    assert Nameless.design_names() == ("design 0", "design 1", "design 2", "design 3")


# ---- devices and the user's folder ----


def test_what_is_handed_out_is_the_users_own():
    env, spoilt = HopperMorph(num_runs=2, seed=0), HopperMorph(num_runs=2, seed=0)
    env.reset()
    td = spoilt.reset()
    for action in some_actions(env, 3):
        td.zero_()
        expected = env.step(TensorDict({"action": action.clone()}, [2]))["next"]
        td = spoilt.step(TensorDict({"action": action.clone()}, [2]))["next"]
        assert (td == expected).all()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_a_gpu_the_tensors_live_there_and_say_the_same():
    env, reference = HopperMorph(num_runs=2, seed=0, device="cuda"), HopperMorph(num_runs=2, seed=0)
    check_env_specs(env)
    env.set_seed(0)
    td = env.reset()
    reference.reset()
    assert td["observation"].is_cuda
    for action in some_actions(reference, 5):
        got = env.advance(action.cuda())
        for a, b in zip(got, reference.advance(action)):
            assert a.is_cuda
            assert a.cpu().equal(b)


def test_a_device_that_the_machine_has_is_taken():
    env = HopperMorph(seed=0, device="cpu")
    assert env.reset().device == torch.device("cpu")
    check_env_specs(env)
