"""The dream: specs, resets, steps, copies, and what it refuses."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable

import pytest
import torch
from point_mass_dream import Physics, PointMass, make_dream, start_of
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import (
    EnvBase,
    PendulumEnv,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from coim.envs.hopper import HopperMorph
from coim.envs.world_model import WorldModelEnv
from coim.models.ensemble import GaussianEnsemble


@pytest.mark.parametrize(("batch_size", "num_runs"), [((256,), 1), ((256,), 3), ((1,), 1), ((), 1), ((5, 3), 3)])
def test_specs_hold_for_any_batch_size(batch_size: tuple[int, ...], num_runs: int) -> None:
    check_env_specs(make_dream(*batch_size, num_runs=num_runs))


def test_a_reset_starts_where_it_is_told_to() -> None:
    dream, start = make_dream(7), start_of(7)
    state = dream.reset(start.clone())
    assert torch.equal(state["observation"], start["observation"])
    assert torch.equal(state["design"], start["design"])
    assert not state["done"].any()
    assert torch.equal(dream.reset()["observation"], start["observation"])


def test_a_reset_may_give_only_new_designs() -> None:
    dream, start = make_dream(7), start_of(7)
    dream.reset(start)
    state = dream.reset(TensorDict({"design": torch.ones(7, 2)}, [7]))
    assert torch.equal(state["observation"], start["observation"])
    assert torch.equal(state["design"], torch.ones(7, 2))


def test_numbers_of_another_dtype_are_brought_to_that_of_the_specs() -> None:
    dream, twin, action = make_dream(7), make_dream(7), torch.full((7, 1), 0.5)
    for start in (start_of(7), start_of(7, seed=1)):
        state = dream.reset(start.double())
        assert torch.equal(state["observation"], start["observation"])
        given = TensorDict({**start.double(), "action": action.double()}, [7])
        after, expected = (env.step(td)["next"] for env, td in ((dream, given), (twin, start.set("action", action))))
        assert after["observation"].dtype == torch.float32
        assert (after == expected).all()


def test_a_step_by_hand() -> None:
    dream = make_dream(1)
    state = dream.reset(
        TensorDict({"observation": torch.tensor([[1.0, 2.0, 0.0]]), "design": torch.full((1, 2), 2.0)}, [1])
    )
    after = dream.step(state.set("action", torch.tensor([[1.0]])))["next"]
    assert after["observation"][0, :2].tolist() == pytest.approx([1.2, 2.05])
    assert after["reward"].tolist() == [[pytest.approx(1.95)]]
    assert after["design"].tolist() == [[2.0, 2.0]]
    assert not (after["done"] | after["terminated"] | after["truncated"]).any()


def test_a_rollout_carries_the_design_and_the_state() -> None:
    dream, start = make_dream(4, 3, num_runs=3), start_of(4, 3)
    rollout = dream.rollout(6, auto_reset=False, tensordict=dream.reset(start))
    assert rollout.batch_size == (4, 3, 6)
    assert torch.equal(rollout["design"], start["design"].unsqueeze(2).expand(4, 3, 6, 2))
    assert torch.equal(rollout["next", "design"], rollout["design"])
    assert torch.equal(rollout["observation"][..., 1:, :], rollout["next", "observation"][..., :-1, :])


def test_a_partial_reset_leaves_the_other_rows_alone() -> None:
    dream, start = make_dream(3), start_of(3)
    state = dream.step_and_maybe_reset(dream.rand_action(dream.reset(start.clone())))[1]
    here = state["observation"].clone()
    mask = torch.tensor([[False], [True], [False]])
    after = dream.reset(state.select("done", "terminated", "truncated", "observation", "design").set("_reset", mask))
    assert torch.equal(after["observation"][[0, 2]], here[[0, 2]])
    assert torch.equal(after["design"], start["design"])


def test_rows_that_are_not_reset_keep_their_start_and_may_hold_anything() -> None:
    dream, start = make_dream(3), start_of(3)
    dream.reset(start.clone())
    other = TensorDict({"observation": torch.full((3, 3), 5.0), "design": torch.full((3, 2), 0.7)}, [3])
    other["observation"][2] = torch.nan
    other["design"][0] = 9.0
    dream.reset(other.clone().set("_reset", torch.tensor([[False], [True], [False]])))
    again = dream.reset()
    for key in ("observation", "design"):
        assert torch.equal(again[key][1], other[key][1])
        assert torch.equal(again[key][[0, 2]], start[key][[0, 2]])
    with pytest.raises(ValueError, match="start observation holds nan"):
        dream.reset(other.set("_reset", torch.tensor([[False], [False], [True]])))


def test_a_horizon_starts_the_dream_again_from_its_start_states() -> None:
    dream, start = make_dream(3), start_of(3)
    env = TransformedEnv(dream, StepCounter(max_steps=4))
    state = env.reset(start.clone())
    rollout = env.rollout(9, break_when_any_done=False, auto_reset=False, tensordict=state)
    assert torch.equal(rollout["observation"][:, 0], start["observation"])
    assert torch.equal(rollout["observation"][:, 4], start["observation"])
    assert torch.equal(rollout["observation"][:, 8], start["observation"])
    assert torch.equal(rollout["design"], start["design"].unsqueeze(1).expand(3, 9, 2))
    assert rollout["next", "truncated"].sum() == 6


def test_the_same_seed_dreams_the_same_and_global_random_numbers_stay() -> None:
    before = torch.get_rng_state()
    start = start_of(5)
    action = torch.zeros(5, 1)
    dreams = [make_dream(5, seed=seed) for seed in (1, 1, 2)]
    after = [dream.step(dream.reset(start.clone()).set("action", action))["next", "observation"] for dream in dreams]
    assert torch.equal(after[0], after[1])
    assert not torch.equal(after[0], after[2])
    dreams[2].set_seed(1)
    again = dreams[2].step(dreams[2].reset(start.clone()).set("action", action))["next", "observation"]
    assert torch.equal(after[0], again)
    assert torch.equal(torch.get_rng_state(), before)


def test_unseeded_dreams_differ() -> None:
    first, second = (make_dream(5, seed=None).reset()["observation"] for _ in range(2))
    assert not torch.equal(first, second)


def test_advance_takes_any_batch_and_lets_gradients_through() -> None:
    action = torch.zeros(2, 4, 1, requires_grad=True)
    start = start_of(2, 4)
    after, reward = make_dream(1).advance(start["observation"], action, start["design"])
    assert (after.shape, reward.shape) == ((2, 4, 3), (2, 4, 1))
    reward.sum().backward()
    assert torch.allclose(action.grad, 0.1 / start["design"][..., :1])


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("design", 3.0, r"design \[3.0, 3.0\] leaves \[\[0.5, 0.5\], \[2.0, 2.0\]\]; project it"),
        ("design", float("nan"), "start design holds nan"),
        ("observation", float("inf"), "start observation holds inf"),
    ],
)
def test_a_bad_start_is_named_and_changes_nothing(key: str, value: float, message: str) -> None:
    dream, start = make_dream(4), start_of(4)
    dream.reset(start.clone())
    bad = start.clone()
    bad[key][2] = value
    with pytest.raises(ValueError, match=message):
        dream.reset(bad)
    assert torch.equal(dream.reset()[key], start[key])


def test_a_start_of_the_wrong_length_is_named() -> None:
    with pytest.raises(ValueError, match=r"start design has shape \[4, 3\], not \[4, 2\]"):
        make_dream(4).reset(TensorDict({"design": torch.ones(4, 3)}, [4]))


def test_an_empty_reset_goes_back_to_the_starts() -> None:
    dream, start, empty = make_dream(3), start_of(3), TensorDict({}, [3])
    dream.rollout(3, auto_reset=False, tensordict=dream.reset(start.clone()))
    assert torch.equal(dream.reset(empty)["observation"], start["observation"])
    assert torch.equal(empty["design"], start["design"])


def test_rows_that_are_not_stepped_stay_where_they_are() -> None:
    dream, start = make_dream(3), start_of(3)
    td = dream.reset(start.clone()).set("action", torch.zeros(3, 1)).set("_step", torch.tensor([True, False, True]))
    after = dream.step(td)["next"]
    assert torch.equal(after["observation"][1], start["observation"][1])
    assert (after["observation"][::2] != start["observation"][::2]).any(-1).all()
    assert (after["reward"] == 0).flatten().tolist() == [False, True, False]


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda dream: pickle.loads(pickle.dumps(dream))])
@pytest.mark.parametrize("wrapped", [False, True])
def test_a_copy_dreams_on_to_the_last_bit(copied: Callable, wrapped: bool) -> None:
    env = HopperMorph(num_runs=2, seed=0)
    dream: EnvBase = WorldModelEnv(GaussianEnsemble.for_env(env, num_cells=(8,)), env, batch_size=[4], seed=0)
    dream = TransformedEnv(dream, StepCounter(9)) if wrapped else dream
    td = dream.rand_step(dream.reset())["next"].exclude("reward")  # with the graph of the ensemble
    other = copied(dream)
    td["action"] = torch.zeros(4, 3)
    a, b = (x.step(td.clone())["next"] for x in (dream, other))
    assert torch.equal(a["observation"], b["observation"])
    assert torch.equal(dream.reset()["observation"], other.reset()["observation"])


def test_a_dream_that_is_moved_takes_its_random_numbers_and_its_states_along() -> None:
    start, moved, whole = start_of(5), make_dream(5), make_dream(5)
    for dream in (moved, whole):
        dream.reset(start.clone())
    assert moved.to("cpu") is moved
    assert moved.reset().device == torch.device("cpu")
    action = torch.zeros(5, 1)
    a, b = (dream.step(dream.reset().set("action", action))["next", "observation"] for dream in (moved, whole))
    assert torch.equal(a, b)


def test_what_is_no_bare_body_and_a_flat_reward_are_refused() -> None:
    class FlatlyPaid(PointMass):
        @staticmethod
        def reward_fn(observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor) -> Tensor:
            return next_observation[..., 1]

    with pytest.raises(TypeError, match=r"pass env.base_env to the dream"):
        WorldModelEnv(Physics(), TransformedEnv(PointMass(), StepCounter()), batch_size=[3])
    for env in (SerialEnv(2, PointMass), PendulumEnv()):
        with pytest.raises(TypeError, match=rf"a {type(env).__name__} has no reward_fn and design_spec of its own"):
            WorldModelEnv(Physics(), env, batch_size=[3])
    with pytest.raises(ValueError, match=r"the reward of FlatlyPaid has shape \[2\] .*not \[2, 1\]"):
        WorldModelEnv(Physics(), FlatlyPaid(), batch_size=[3])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_specs_hold_under_any_default_dtype(dtype: torch.dtype) -> None:
    torch.set_default_dtype(dtype)
    try:
        check_env_specs(make_dream(5))
    finally:
        torch.set_default_dtype(torch.float32)
