import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, MultiOneHot, Unbounded
from torchrl.envs import ExplorationType, set_exploration_type

from coim.models import GaussianEnsemble, make_policy, make_qvalue, select_run


def test_it_writes_what_an_actor_writes(toy_env, make_rows):
    rows = make_policy(toy_env, num_cells=(8,))(make_rows(4, dtype=torch.float32).exclude("action"))
    assert {key: tuple(rows[key].shape) for key in ("loc", "scale", "action", "action_log_prob")} == {
        "loc": (4, 2),
        "scale": (4, 2),
        "action": (4, 2),
        "action_log_prob": (4,),
    }
    assert rows["action"].abs().max() <= 1


def test_it_acts_by_the_tanh_of_loc_when_deterministic(toy_env, make_rows):
    policy = make_policy(toy_env, num_cells=(8,))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rows = policy(make_rows(4, dtype=torch.float32))
    torch.testing.assert_close(rows["action"], rows["loc"].tanh())


def test_it_samples_by_default_and_density_matches(toy_env, make_rows):
    policy = make_policy(toy_env, num_cells=(8,)).double()
    rows = policy(make_rows(4))
    assert not torch.equal(rows["action"], rows["loc"].tanh())
    torch.testing.assert_close(policy.get_dist(rows).log_prob(rows["action"]), rows["action_log_prob"])


def test_the_design_matters(toy_env, make_rows):
    policy, rows = make_policy(toy_env, num_cells=(8,)).double(), make_rows(4)
    loc, _ = policy.network(rows["observation"], rows["design"])
    other, _ = policy.network(rows["observation"], rows["design"] + 1)
    assert (loc != other).all()


@pytest.mark.parametrize(("bias", "scale"), [(100.0, math.exp(2)), (-100.0, math.exp(-20)), (0.5, math.exp(0.5))])
def test_the_log_scale_is_clamped(toy_env, make_rows, bias, scale):
    policy, rows = make_policy(toy_env, num_cells=(8,)).double(), make_rows(4)
    last = policy.network.mlp.layers[-1]
    last.weight.data.zero_()
    last.bias.data.fill_(bias)
    _, ours = policy.network(rows["observation"], rows["design"])
    torch.testing.assert_close(ours, torch.full_like(ours, scale))


def test_a_run_of_a_fleet_is_a_policy_of_its_own(toy_env, make_rows):
    fleet, rows = make_policy(toy_env, num_cells=(8, 8), num_runs=3).double(), make_rows(5, 3)
    alone = select_run(fleet, 1)
    assert (fleet.num_runs, alone.num_runs) == (3, None)
    both = (
        fleet.network(rows["observation"], rows["design"]),
        alone.network(*rows[:, 1].select("observation", "design").values()),
    )
    for ours, expected in zip(*both):
        torch.testing.assert_close(ours[:, 1], expected, rtol=1e-13, atol=1e-14)


def test_it_drives_an_environment(toy_env):
    rollout = toy_env.rollout(5, make_policy(toy_env, num_cells=(8,)))
    assert rollout["action"].shape == (1, 5, 2)


def test_a_foreign_environment_needs_three_specs_only():
    class Foreign:
        observation_spec = Composite(observation=Unbounded((7,)))
        design_spec = Unbounded((1,))
        action_spec = Bounded(-1, 1, shape=(2,))

    policy = make_policy(Foreign(), num_cells=(8,))
    td = TensorDict({"observation": torch.zeros(1, 7), "design": torch.zeros(1, 1)}, [1])
    assert policy(td)["action"].shape == (1, 2)


@pytest.mark.parametrize("make", [make_policy, make_qvalue, GaussianEnsemble.for_env])
def test_an_environment_without_designs_is_told_what_it_must_be(make):
    class Fixed:
        observation_spec = Composite(observation=Unbounded((7,)))
        action_spec = Bounded(-1, 1, shape=(2,))

    with pytest.raises(ValueError, match=r"Fixed has no designs, .*; take a MorphEnv such as HopperMorph, its dream"):
        make(Fixed())


@pytest.mark.parametrize("spec", [Bounded(-2, 2, shape=(2,)), Unbounded((2,)), MultiOneHot([3, 3])])
def test_actions_that_a_tanh_cannot_reach_are_refused(toy_env, spec):
    class Foreign:
        observation_spec, design_spec, action_spec = toy_env.observation_spec, toy_env.design_spec, spec

    with pytest.raises(ValueError, match="ActionScaling"):
        make_policy(Foreign())


@pytest.mark.parametrize(("runs", "rows"), [(None, 1), (None, 4), (1, 1), (3, 3)])
def test_prepared_for_an_episode_it_computes_the_same_bits(toy_env, runs, rows):
    torch.manual_seed(0)
    policy = make_policy(toy_env, num_cells=(16, 16), num_runs=runs)
    observations, design = torch.randn(5, rows, 3), torch.rand(rows, 2) + 0.5
    network = policy.network.for_design(design)
    with torch.no_grad():
        for observation in observations:
            for ours, expected in zip(network(observation), policy.network(observation, design)):
                assert torch.equal(ours, expected)
        policy.network.mlp.layers[0].weight.mul_(2)  # as a learner does
        assert torch.equal(network(observations[0])[0], policy.network(observations[0], design)[0])
