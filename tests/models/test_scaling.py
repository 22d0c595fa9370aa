"""What the networks' inputs are scaled by."""

from __future__ import annotations

import pytest
import torch

from coim import HalfCheetahMorph, HopperMorph, SACLearner, WalkerMorph, make_policy, make_qvalue, run_episode
from coim.models import InputScaling


@pytest.mark.parametrize("body", [HalfCheetahMorph, WalkerMorph, HopperMorph])
def test_the_constants_of_a_body_are_the_spreads_under_random_actions(body: type) -> None:
    env = body(num_runs=16, seed=0)
    rows = run_episode(env, None, rng=torch.Generator().manual_seed(0))
    ratio = rows["observation"].flatten(0, 1).std(0) / env.observation_scale
    if body is WalkerMorph:
        ratio = ratio[1:]  # the distance travelled is scaled by what walking covers, not by random actions
    assert ratio.min() > 0.4
    assert ratio.max() < 1.6


def test_networks_see_scaled_observations_and_designs_in_unit_range() -> None:
    env = HopperMorph(seed=0)
    policy = make_policy(env, num_cells=(8,))
    observation, design = env.observation_scale * 2, torch.tensor([0.5, 1.25, 2.0, 2.0])
    raw = policy.network.mlp(torch.full((11,), 2.0), torch.tensor([-1.0, 0.0, 1.0, 1.0]))
    torch.testing.assert_close(policy.network(observation, design)[0], raw[:3])


def test_without_constants_observations_pass_as_they_are(toy_env: object) -> None:
    scaling = InputScaling.for_env(toy_env)  # type: ignore[arg-type]
    observation = torch.randn(4, 3)
    assert torch.equal(scaling(observation, torch.ones(4, 2))[0], observation)


def test_walker_without_root_x_has_the_other_constants() -> None:
    scale = WalkerMorph().observation_scale
    assert torch.equal(WalkerMorph(observe_root_x=False).observation_scale, scale[1:])


def test_bad_scales_and_networks_that_disagree_are_refused() -> None:
    one = torch.ones(1)
    with pytest.raises(ValueError, match="must be positive"):
        InputScaling(torch.tensor([1.0, 0.0]), one, 2 * one)
    with pytest.raises(ValueError, match="must leave a range"):
        InputScaling(one, one, one)
    env = HopperMorph(seed=0)
    qvalue = make_qvalue(env, num_cells=(8,))
    qvalue.module.scaling.observation_scale[0] = 7.0
    with pytest.raises(ValueError, match="scale their inputs differently"):
        SACLearner(make_policy(env, num_cells=(8,)), qvalue)
