"""The environment as TorchRL sees it: specs, designs through resets, seeds, broken rows, and what bad input gets."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from physics_checks import reset_to
from tensordict import TensorDict
from torchrl.envs import Compose, RewardSum, SerialEnv, StepCounter, TransformedEnv, check_env_specs
from torchrl.envs.utils import RandomPolicy

from coim.envs import HalfCheetahMorph, HopperMorph, MorphEnv, WalkerMorph

BODIES = pytest.mark.parametrize("body", [HalfCheetahMorph, WalkerMorph, HopperMorph])
SIZES = {HalfCheetahMorph: (17, 6, 6), WalkerMorph: (18, 7, 6), HopperMorph: (11, 4, 3)}  # S, D, A


def some_designs(env: MorphEnv, seed: int = 0) -> torch.Tensor:
    low, high = env.DESIGN_BOUNDS
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(env.numel(), env.DESIGN_SIZE, generator=generator)


def some_actions(env: MorphEnv, num_steps: int, seed: int = 0) -> torch.Tensor:
    return 2 * torch.rand(num_steps, *env.action_spec.shape, generator=torch.Generator().manual_seed(seed)) - 1


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


# ---- seeds ----


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


# ---- rows that break ----


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


# ---- place ----


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


def test_place_refuses_what_is_no_state():
    env = HopperMorph(num_runs=2, seed=0)
    with pytest.raises(ValueError, match=r"observation must be finite and of shape \[2, 11\]"):
        env.place(torch.full((2, 11), math.nan), torch.ones(2, 4))
    with pytest.raises(ValueError, match="design"):
        env.place(torch.zeros(2, 11), torch.ones(2, 5))


def test_capsules_show_the_body_of_the_row():
    env = HopperMorph(num_runs=2, reset_noise=0)
    reset_to(env, torch.tensor([[1.0] * 4, [2.0] * 4]))
    unit, tall = (env.capsules(run) for run in range(2))
    assert unit.shape == tall.shape == (4, 7)  # torso, thigh, leg, foot
    assert unit[:, [2, 5]].max().item() == pytest.approx(1.25 + 0.2)
    assert tall[:, [2, 5]].max().item() == pytest.approx(2.4 + 0.4)


# ---- bad input ----


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"num_runs": 0}, "num_runs 0 is not a whole number of at least 1"),
        ({"num_runs": 1.5}, "num_runs 1.5 is not a whole number"),
        ({"episode_steps": -1}, "episode_steps -1 is not a whole number of at least 1"),
        ({"num_threads": 0}, "num_threads 0 is not a whole number of at least 1"),
        ({"reset_noise": -0.1}, "reset_noise -0.1 is not a finite number of at least 0"),
        ({"reset_noise": math.nan}, "reset_noise nan"),
        ({"task": "sideways"}, "unknown task 'sideways'; choose 'forward' or 'backward'"),
        ({"device": "cuda:99"}, "device 'cuda:99' does not exist here"),
    ],
)
@BODIES
def test_a_bad_argument_gets_a_sentence(body, arguments, sentence):
    with pytest.raises(ValueError, match=sentence):
        body(**arguments)


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


@pytest.mark.parametrize(
    ("constants", "sentence"),
    [
        ({"DESIGN_BOUNDS": (2.0, 0.5)}, r"Odd\.DESIGN_BOUNDS is \(2\.0, 0\.5\); .* low < high, with 1 between them"),
        ({"DESIGN_BOUNDS": (1.0, 1.0)}, "low < high"),
        ({"DESIGN_BOUNDS": (1.2, 2.0)}, "with 1 between them: the body as drawn, which is the first"),
        ({"DESIGN_BOUNDS": (0.5, math.nan)}, "low < high"),
        ({"FRAME_SKIP": 0}, r"Odd\.FRAME_SKIP is 0, not a whole number of at least 1"),
        ({"RESET_NOISE": -0.1}, "reset_noise -0.1 is not a finite number"),
    ],
)
def test_constants_that_no_body_can_have_are_refused(constants, sentence):
    with pytest.raises(ValueError, match=sentence):
        type("Odd", (HopperMorph,), constants)()


@pytest.mark.parametrize("names", [("a", "b", "c"), ("a", "b", "c", "c"), ("a", "b", "c", "d,e"), ("a", "b", "c", "")])
def test_names_that_do_not_fit_the_design_are_refused(names):
    class Misnamed(HopperMorph):
        DESIGN_NAMES = names

    with pytest.raises(ValueError, match=r"Misnamed.DESIGN_NAMES is .* not 4 different names .* leave it out"):
        Misnamed()


@pytest.mark.parametrize(
    ("design", "sentence"),
    [
        ([[1.0, 1.0, 1.0, 2.1]], r"leaves \[0.5, 2\]; clip it with design_spec.project"),
        ([[0.4, 1.0, 1.0, 1.0]], r"leaves \[0.5, 2\]"),
        ([[1.0, math.nan, 1.0, 1.0]], r"nan.* leaves \[0.5, 2\]"),
        ([[1.0, 1.0, 1.0]], r"design has shape \[1, 3\], this fleet takes \[1, 4\]"),
    ],
)
def test_a_bad_design_gets_a_sentence_and_the_body_stays(design, sentence):
    env = HopperMorph(seed=0)
    with pytest.raises(ValueError, match=sentence):
        env.reset(TensorDict({"design": torch.tensor(design)}, [1]))
    assert env.reset()["design"].tolist() == [[1.0] * 4]


@pytest.mark.parametrize(
    ("action", "sentence"),
    [
        (torch.zeros(3), r"action has shape \[3\], the fleet takes \[2, 3\]"),
        (torch.zeros(2, 4), r"action has shape \[2, 4\]"),
        (torch.full((2, 3), math.nan), "is not finite"),
    ],
)
def test_a_bad_action_gets_a_sentence_and_nothing_moves(action, sentence):
    env = HopperMorph(num_runs=2, seed=0)
    env.reset()
    before = env.get_simulation_state()
    with pytest.raises(ValueError, match=sentence):
        env.advance(action)
    assert (env.get_simulation_state() == before).all()


def test_a_state_of_another_fleet_size_gets_a_sentence():
    with pytest.raises(ValueError, match="the state holds 3 runs, this fleet has 2"):
        HopperMorph(num_runs=2).set_simulation_state(HopperMorph(num_runs=3).get_simulation_state())


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


def test_a_broken_row_leaves_no_file_behind(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env = HopperMorph(seed=0)
    env.reset()
    env.simulations.qvel[0] = math.nan
    env.advance(torch.zeros(1, 3))
    assert list(tmp_path.iterdir()) == []
