"""The dream of real bodies: it agrees with them, takes fleets, and leaves them alone."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from coim.envs.half_cheetah import HalfCheetahMorph
from coim.envs.hopper import HopperMorph
from coim.envs.morph import MorphEnv
from coim.envs.task import Task
from coim.envs.walker import WalkerMorph
from coim.envs.world_model import WorldModelEnv
from coim.models.ensemble import GaussianEnsemble

BODIES = [HalfCheetahMorph, WalkerMorph, HopperMorph]


class Twin:
    """A perfect model: a second fleet of the same bodies, stepped beside the first and asked where it stands."""

    def __init__(self, env: MorphEnv, start: TensorDictBase) -> None:
        self.env = env
        self.here = env.reset(start)["observation"]

    def sample(
        self, observation: Tensor, action: Tensor, design: Tensor, *, generator: torch.Generator | None = None
    ) -> Tensor:
        assert torch.equal(observation, self.here)
        self.here, _, _ = self.env.advance(action)
        return self.here


class Simulator:
    """A perfect model: the simulator, set to each state and body that it is asked for."""

    def __init__(self, env: MorphEnv) -> None:
        self.env = env

    def sample(
        self, observation: Tensor, action: Tensor, design: Tensor, *, generator: torch.Generator | None = None
    ) -> Tensor:
        self.env.place(observation, design)
        return self.env.advance(action)[0]


def random_bodies(body: type[MorphEnv], num_runs: int, seed: int = 0) -> TensorDict:
    low, high = body.DESIGN_BOUNDS
    uniform = torch.rand(num_runs, body.DESIGN_SIZE, generator=torch.Generator().manual_seed(seed))
    return TensorDict({"design": low + (high - low) * uniform}, [num_runs])


@pytest.mark.parametrize("task", ["forward", "backward"])
@pytest.mark.parametrize("body", BODIES)
def test_a_perfect_model_dreams_the_real_observations_and_rewards_to_the_last_bit(
    body: type[MorphEnv], task: Task
) -> None:
    num_runs, steps = 4, 50
    bodies = random_bodies(body, num_runs)
    env = body(num_runs=num_runs, task=task, seed=0)
    start = env.reset(bodies.clone())
    twin = Twin(body(num_runs=num_runs, task=task, seed=0), bodies.clone())
    dream = WorldModelEnv(twin, env, batch_size=[num_runs])
    real = env.rollout(steps, auto_reset=False, tensordict=start.clone())
    actions = iter(real["action"].unbind(1))
    dreamt = dream.rollout(
        steps,
        lambda observation, design: next(actions),
        auto_reset=False,
        tensordict=dream.reset(start.select("observation", "design")),
    )
    for key in ("observation", "design", ("next", "observation"), ("next", "reward"), ("next", "design")):
        assert torch.equal(dreamt[key], real[key]), key


@pytest.mark.parametrize("body", BODIES)
def test_the_simulator_as_a_model_agrees_from_any_state_of_any_body(body: type[MorphEnv]) -> None:
    num_runs = 8
    torch.manual_seed(0)  # for the rollout's random actions
    env = body(num_runs=num_runs, seed=0)
    rows = env.rollout(30, auto_reset=False, tensordict=env.reset(random_bodies(body, num_runs)))[:, -1]
    dream = WorldModelEnv(Simulator(body(num_runs=num_runs)), env, batch_size=[num_runs])
    after = dream.step(dream.reset(rows.select("observation", "design")).set("action", rows["action"]))["next"]
    # A float32 observation is not the simulation's float64 state, and knows nothing of the solver's warm start.
    torch.testing.assert_close(after["observation"], rows["next", "observation"], rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(after["reward"], rows["next", "reward"], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("body", BODIES)
def test_specs_hold_with_a_real_body_and_a_real_ensemble(body: type[MorphEnv]) -> None:
    env = body(num_runs=2, seed=0)
    check_env_specs(WorldModelEnv(GaussianEnsemble.for_env(env, num_cells=(8,)), env, batch_size=[256]))
    fleet = GaussianEnsemble.for_env(env, num_cells=(8,), num_runs=2)
    check_env_specs(WorldModelEnv(fleet, env, batch_size=[16, 2]))


def test_a_fleet_of_models_dreams_rollouts_with_its_runs_last() -> None:
    env = HopperMorph(num_runs=3, seed=0)
    dream = WorldModelEnv(GaussianEnsemble.for_env(env, num_cells=(8,), num_runs=3), env, batch_size=[5, 3], seed=0)
    start = env.reset(random_bodies(HopperMorph, 3)).select("observation", "design").expand(5, 3)
    rollout = dream.rollout(4, auto_reset=False, tensordict=dream.reset(start.clone()))
    assert rollout.batch_size == (5, 3, 4)
    assert rollout["next", "observation"].isfinite().all()
    here, there, design = rollout["observation"], rollout["next", "observation"], rollout["design"]
    assert torch.equal(rollout["next", "reward"], HopperMorph.reward(here, rollout["action"], there, design))


def test_the_dream_does_not_step_the_real_bodies() -> None:
    env, untouched = (HopperMorph(num_runs=1, seed=0) for _ in range(2))
    dream = WorldModelEnv(GaussianEnsemble.for_env(env, num_cells=(8,)), env, batch_size=[1])
    dream.rollout(5)
    action = torch.zeros(1, 3)
    assert torch.equal(env.advance(action)[0], untouched.advance(action)[0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_specs_hold_under_any_default_dtype(dtype: torch.dtype) -> None:
    torch.set_default_dtype(dtype)
    try:
        check_env_specs(WorldModelEnv(Simulator(HopperMorph(num_runs=4)), HopperMorph(), batch_size=[4]))
    finally:
        torch.set_default_dtype(torch.float32)
