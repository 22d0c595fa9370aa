"""Copies of environments, by pickle and deepcopy, go on as the original; and torch's defaults change nothing."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
import torch
from physics_checks import reset_to
from tensordict import TensorDict
from torchrl.envs import StepCounter, TransformedEnv, check_env_specs

from coim.envs import HalfCheetahMorph, HopperMorph, MorphEnv, SimulatorDynamics, WalkerMorph

BODIES = pytest.mark.parametrize("body", [HalfCheetahMorph, WalkerMorph, HopperMorph])
COPIED = pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])


def actions_of(env: MorphEnv, num_steps: int) -> torch.Tensor:
    shape = (num_steps, *env.action_spec.shape)
    return 2 * torch.rand(shape, generator=torch.Generator().manual_seed(0), dtype=torch.float32, device="cpu") - 1


@BODIES
@COPIED
def test_a_copy_goes_on_to_the_last_bit_and_by_itself(body: type[MorphEnv], copied: Callable) -> None:
    env = body(num_runs=2, seed=3, episode_steps=8, task="backward")
    reset_to(env, env.design_spec.rand((2,)))
    actions = actions_of(env, 12)
    for action in actions[:5]:
        env.step(TensorDict({"action": action}, [2]))
    other = copied(env)
    for action in actions[5:]:
        a, b = (e.step(TensorDict({"action": action}, [2]))["next"] for e in (env, other))
        assert (a == b).all()
    assert a["truncated"].all()
    assert (env.reset() == other.reset()).all()
    env.advance(actions[0])
    assert not (env.get_simulation_state() == other.get_simulation_state()).all()


@COPIED
def test_a_copy_keeps_what_a_body_was_made_with(copied: Callable) -> None:
    env = HalfCheetahMorph(segment_lengths=(0.29, 0.3, 0.188, 0.29, 0.3, 0.188), num_threads=2, reset_noise=0.0)
    other = copied(env)
    assert torch.equal(other.capsules(), env.capsules())
    assert other.reset_noise == 0.0
    assert copied(WalkerMorph(observe_root_x=False)).reset()["observation"].shape == (1, 17)
    assert copied(TransformedEnv(HopperMorph(), StepCounter(3))).rollout(9).shape == (1, 3)
    bodies = copied(SimulatorDynamics(HopperMorph(num_runs=4)))
    observation = torch.zeros(4, 11)
    observation[:, 0] = 1.25
    assert bodies.sample(observation, torch.zeros(4, 3), torch.ones(4, 4)).shape == (4, 11)


# ---- torch's defaults ----


@contextmanager
def defaults(dtype: torch.dtype, device: str) -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    torch.set_default_device(device)
    try:
        yield
    finally:
        torch.set_default_device(None)
        torch.set_default_dtype(before)


@BODIES
def test_specs_hold_and_numbers_stay_under_another_default_dtype(body: type[MorphEnv]) -> None:
    expected = body(num_runs=2, seed=0).reset()
    with defaults(torch.float64, "cpu"):
        env = body(num_runs=2, seed=0)
        check_env_specs(env)
        env.set_seed(0)
        td = env.reset()
        assert (td == expected).all()
        assert {td["observation"].dtype, td["design"].dtype, env.observation_scale.dtype} == {torch.float32}
        assert env.rand_step(td)["next", "reward"].dtype == torch.float32


@BODIES
def test_a_body_on_the_cpu_computes_there_whatever_the_default_device(body: type[MorphEnv]) -> None:
    """The meta device stands in for a GPU: a tensor that is made there by mistake has no numbers."""
    whole = body(num_runs=2, seed=0)
    with defaults(torch.float32, "meta"):
        env = body(num_runs=2, seed=0, device="cpu")
        check_env_specs(env, seed=0)
        env.set_seed(0)
        actions, found = actions_of(env, 3), [env.reset()["observation"]]
        found += [env.advance(action)[0] for action in actions]
    assert torch.equal(found[0], whole.reset()["observation"])
    for observation, action in zip(found[1:], actions):
        assert torch.equal(observation, whole.advance(action)[0])


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_without_a_device_the_tensors_go_to_torchs_default() -> None:
    with defaults(torch.float32, "cuda"):
        env = HopperMorph(num_runs=2, seed=0)
        assert env.reset()["observation"].is_cuda
        check_env_specs(env)
