"""One episode as rows: the same numbers as TorchRL's rollout, and what becomes of a broken simulation."""

from __future__ import annotations

import re
from collections.abc import Callable
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.collectors import RandomPolicy
from torchrl.envs import ExplorationType, ObservationNorm, TransformedEnv, set_exploration_type

from coim import HopperMorph, make_policy, run_episode
from coim.buffers import ROW_KEYS
from coim.models import Policy, PolicyNetwork
from coim.models.stacked import StackedMLP


class Doubled(PolicyNetwork):
    """Acts by twice the mean."""

    def forward(self, observation: torch.Tensor, design: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        loc, scale = super().forward(observation, design)
        return 2 * loc, scale


class Negated(Policy):
    """Does the opposite."""

    def forward(self, tensordict: TensorDict) -> TensorDict:
        tensordict = super().forward(tensordict)
        return tensordict.set("action", -tensordict["action"])


def other_activation(policy: Policy) -> TensorDictModuleBase:
    policy.network.mlp = StackedMLP(15, 6, (8,), activation=nn.ELU)
    return policy


def other_network(policy: Policy) -> TensorDictModuleBase:
    return Policy(Doubled(11, 4, 3, num_cells=(8,), scaling=policy.network.scaling))


def other_layer(policy: Policy) -> TensorDictModuleBase:
    policy.network.mlp.layers[0].register_forward_hook(lambda module, given, out: 2 * out)
    return policy


def other_distribution(policy: Policy) -> TensorDictModuleBase:
    policy[-1].distribution_kwargs = {"low": -0.5, "high": 0.5}
    return policy


def foreign(policy: Policy) -> TensorDictModuleBase:
    return TensorDictModule(lambda observation: observation[:, :3].sin(), in_keys=["observation"], out_keys=["action"])


ALTERED = [other_activation, other_network, other_layer, other_distribution, foreign, lambda p: Negated(p.network)]


def test_a_deterministic_episode_equals_a_rollout_with_the_same_policy() -> None:
    designs = torch.tensor([[1.0, 1.0, 1.0, 1.0], [0.7, 1.3, 0.9, 1.8]])
    torch.manual_seed(0)
    ours, theirs = (HopperMorph(num_runs=2, episode_steps=30, seed=3) for _ in range(2))
    policy = make_policy(ours, num_cells=(16,))

    rows = run_episode(ours, policy, design=designs, deterministic=True)

    start = theirs.reset(TensorDict({"design": designs}, [2]))
    policy_mode = lambda td: td.set("action", policy.network(td["observation"], td["design"])[0].tanh())  # noqa: E731
    rollout = theirs.rollout(30, policy_mode, auto_reset=False, tensordict=start).transpose(0, 1)
    assert set(rows.keys(include_nested=True, leaves_only=True)) == set(ROW_KEYS)
    for key in ROW_KEYS:
        torch.testing.assert_close(rows[key], rollout[key], rtol=0, atol=0)


@pytest.mark.parametrize("alter", ALTERED)
def test_every_policy_acts_as_it_does_when_it_is_called(alter: Callable[[Policy], TensorDictModuleBase]) -> None:
    env = HopperMorph(num_runs=2, episode_steps=5, seed=0)
    policy = alter(make_policy(env, num_cells=(8,)))
    rows = run_episode(env, policy, deterministic=True)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = torch.stack([policy(row)["action"] for row in rows.select("observation", "design")])
    torch.testing.assert_close(rows["action"], expected)


def test_a_policy_that_is_called_draws_from_the_generator_too() -> None:
    def actions(seed: int) -> torch.Tensor:
        env = HopperMorph(episode_steps=4, seed=0)
        return run_episode(env, policy, rng=torch.Generator().manual_seed(seed))["action"]

    policy = Negated(make_policy(HopperMorph(seed=0), num_cells=(8,)).network)
    before = torch.get_rng_state()
    first = actions(1)
    assert torch.equal(first, actions(1))
    assert not torch.equal(first, actions(2))
    assert first.unique().numel() == first.numel()
    assert torch.equal(torch.get_rng_state(), before)


def test_any_function_of_a_tensordict_may_act() -> None:
    def still(tensordict: TensorDict) -> TensorDict:
        return tensordict.set("action", 0.25 * torch.ones(2, 3))

    env = HopperMorph(num_runs=2, episode_steps=4, seed=0)
    assert run_episode(env, still)["action"].unique().tolist() == [0.25]
    drawn = [
        run_episode(env, RandomPolicy(env.action_spec), rng=torch.Generator().manual_seed(seed))["action"]
        for seed in (1, 1, 2)
    ]
    assert torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn[0], drawn[2])
    assert len(drawn[0].unique()) == 4 * 2 * 3


def test_only_the_last_row_is_truncated() -> None:
    rows = run_episode(HopperMorph(num_runs=2, episode_steps=4, seed=0), None)
    assert rows["next", "truncated"].squeeze(-1).tolist() == [[False] * 2] * 3 + [[True] * 2]
    assert not rows["next", "terminated"].any()


def test_random_actions_fill_the_action_space_and_repeat_with_their_generator() -> None:
    def actions(seed: int) -> torch.Tensor:
        env = HopperMorph(num_runs=1, episode_steps=200, seed=0)
        return run_episode(env, None, rng=torch.Generator().manual_seed(seed))["action"]

    first = actions(1)
    assert first.min() < -0.9
    assert first.max() > 0.9
    assert torch.equal(first, actions(1))
    assert not torch.equal(first, actions(2))


def test_a_broken_row_is_terminated_and_starts_again_while_the_other_goes_on() -> None:
    class Breaking(HopperMorph):
        """Throws row 0 beyond physics before its third step."""

        steps = 0

        def move(self, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            if self.steps == 2:
                self.simulations.qvel[0] = 1e12
            self.steps += 1
            return super().move(action)

    breaking, whole = (body(num_runs=2, episode_steps=6, seed=0) for body in (Breaking, HopperMorph))
    rows, expected = (run_episode(env, None, rng=torch.Generator().manual_seed(0)) for env in (breaking, whole))

    assert rows["next", "terminated"][:, 0].squeeze(-1).tolist() == [False, False, True, False, False, False]
    assert all(value.isfinite().all() for value in rows.values(include_nested=True, leaves_only=True))
    start = rows["observation"][3, 0]
    torch.testing.assert_close(start, rows["observation"][0, 0], rtol=0, atol=0.02)  # reset noise is U(+-0.005)
    assert not torch.equal(start, rows["next", "observation"][2, 0])
    assert torch.equal(rows["next", "observation"][:, 1], expected["next", "observation"][:, 1])


def test_a_sampled_action_is_the_tanh_of_loc_plus_scale_times_the_noise_of_the_generator() -> None:
    env = HopperMorph(num_runs=2, episode_steps=7, seed=0)
    policy = make_policy(env, num_cells=(16,))
    rows = run_episode(env, policy, rng=torch.Generator().manual_seed(4))
    noise = torch.randn(7, 2, 3, generator=torch.Generator().manual_seed(4))
    with torch.no_grad():
        loc, scale = policy.network(rows["observation"], rows["design"])
    torch.testing.assert_close(rows["action"], (loc + scale * noise).tanh(), rtol=0, atol=1e-6)


@pytest.mark.parametrize("task", ["forward", "backward"])
def test_the_rewards_of_an_episode_are_those_of_its_steps_to_the_last_bit(task: str) -> None:
    rows = run_episode(HopperMorph(num_runs=3, task=task, episode_steps=40, seed=0), None)
    env = HopperMorph(num_runs=3, task=task, episode_steps=40, seed=0)
    env.reset()
    rewards = torch.stack([env.advance(action)[1] for action in rows["action"]])
    assert torch.equal(rows["next", "reward"], rewards)


class Limping(HopperMorph):
    """Is paid the root of its speed along, which a step backwards does not have."""

    @staticmethod
    def reward(
        observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor, task: str = "forward"
    ) -> Tensor:
        return next_observation[..., 5, None].sqrt()


def test_a_reward_that_is_no_number_is_told_with_its_step_and_its_body() -> None:
    env, plain = (body(num_runs=2, episode_steps=30, seed=0) for body in (Limping, HopperMorph))
    thin, rng = torch.tensor([[1.0] * 4, [1.0, 1.0, 1.0, 0.5]]), torch.Generator()
    rows = run_episode(plain, None, design=thin, rng=rng.manual_seed(0))
    step, row = (rows["next", "observation"][..., 5] < 0).nonzero()[0].tolist()
    sentence = f"the reward of Limping is nan at step {step} for the body {thin[row].tolist()}, although"
    with pytest.raises(ValueError, match=re.escape(sentence)):
        run_episode(env, None, design=thin, rng=rng.manual_seed(0))
    env.reset()
    with pytest.raises(ValueError, match=r"the reward of Limping is nan for the body .* give reward"):
        list(map(env.advance, rows["action"]))


def test_a_transformed_environment_is_refused_by_name() -> None:
    normed = ObservationNorm(loc=1.0, scale=1.0, in_keys=["observation"])
    env = TransformedEnv(HopperMorph(seed=0, episode_steps=3), normed)
    with pytest.raises(
        TypeError, match=r"not TransformedEnv: pass a MorphEnv.*its base_env, or take TorchRL's rollout"
    ):
        run_episode(env, None)
    assert len(run_episode(env.base_env, None)) == 3


def test_a_policy_that_lives_elsewhere_acts_by_a_copy_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """The meta device stands in for a GPU: the original there cannot act at all."""
    env, again = (HopperMorph(num_runs=2, seed=0, episode_steps=5) for _ in range(2))
    here = make_policy(env, num_cells=(8,))
    elsewhere = deepcopy(here).to("meta")
    monkeypatch.setattr(Policy, "cpu", lambda copied: here if copied is not elsewhere else pytest.fail("it was moved"))
    rows, expected = (
        run_episode(bodies, policy, rng=torch.Generator().manual_seed(0))
        for bodies, policy in ((env, elsewhere), (again, here))
    )
    assert (rows == expected).all()
    assert all(parameter.is_meta for parameter in elsewhere.parameters())


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_a_gpu_an_episode_steps_on_the_host_and_its_rows_are_the_cpus() -> None:
    class Watched(HopperMorph):
        """Lets nothing wait for the GPU from the first step to the last."""

        moves = 0

        def move(self, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            assert not action.is_cuda
            self.moves += 1
            torch.cuda.set_sync_debug_mode("error" if self.moves < 20 else "default")
            return super().move(action)

    env = Watched(num_runs=2, seed=0, episode_steps=20, device="cuda")
    reference = HopperMorph(num_runs=2, seed=0, episode_steps=20)
    policy = make_policy(reference, num_cells=(16,))
    expected = run_episode(reference, policy, rng=torch.Generator().manual_seed(0))
    try:
        rows = run_episode(env, deepcopy(policy).cuda(), rng=torch.Generator().manual_seed(0))
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert rows.device.type == "cuda"
    for key in ROW_KEYS:
        assert torch.equal(rows[key].cpu(), expected[key])


def test_an_episode_is_the_same_under_another_default_dtype() -> None:
    def rows() -> TensorDict:
        env = HopperMorph(num_runs=2, seed=0, episode_steps=5)
        return run_episode(env, None, rng=torch.Generator().manual_seed(0))

    expected = rows()
    torch.set_default_dtype(torch.float64)
    try:
        assert (rows() == expected).all()
    finally:
        torch.set_default_dtype(torch.float32)
