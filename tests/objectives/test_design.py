import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import ExplorationType, TransformedEnv, set_exploration_type

from coim.buffers import transition_rows
from coim.envs import HopperMorph
from coim.models import make_policy, make_qvalue
from coim.objectives import DesignValue


@pytest.fixture
def parts(toy_env, make_rows):
    """Policy, critics and seven start states."""
    policy = make_policy(toy_env, num_cells=(8,)).double()
    qvalue = make_qvalue(toy_env, num_cells=(8,)).double()
    return policy, qvalue, make_rows(7).select("observation", "design")


def designs(num: int) -> torch.Tensor:
    return torch.rand(num, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) + 0.5


@pytest.mark.parametrize("chunk_size", [None, 1, 3, 28])
def test_it_is_a_loop_over_designs_and_start_states(parts, chunk_size):
    policy, qvalue, starts = parts
    expected = []
    for design in designs(10):
        values = []
        for observation in starts["observation"]:
            loc, _ = policy.network(observation, design)
            values.append(qvalue.module(observation, loc.tanh(), design).min())
        expected.append(torch.stack(values).mean())
    ours = DesignValue(policy, qvalue, starts, chunk_size=chunk_size)(designs(10))
    torch.testing.assert_close(ours, torch.stack(expected), rtol=1e-12, atol=1e-13)
    assert not ours.requires_grad


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_bare_networks_give_what_their_modules_give(toy_env, precision):
    policy, qvalue = make_policy(toy_env), make_qvalue(toy_env)
    starts = TensorDict({"observation": torch.randn(36, 3)}, [36])
    candidates = designs(100).float()
    bare = DesignValue(policy, qvalue, starts, precision=precision)
    wrapped = DesignValue(TensorDictSequential(policy), TensorDictSequential(qvalue), starts, precision=precision)
    assert bare._networks_are_bare()
    assert not wrapped._networks_are_bare()
    torch.testing.assert_close(bare(candidates), wrapped(candidates), rtol=1e-5, atol=1e-6)
    gradients = []
    for fitness in (bare, wrapped):
        xi = candidates.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(fitness(xi).sum(), xi)
        gradients.append(gradient)
    tolerance = 1e-5 if precision == "float32" else 0.1
    assert (gradients[0] - gradients[1]).norm() <= tolerance * gradients[1].norm()


def test_bfloat16_is_close_and_leaves_the_weights_as_they_are(toy_env):
    torch.manual_seed(0)
    policy, qvalue = make_policy(toy_env), make_qvalue(toy_env)
    starts = TensorDict({"observation": torch.randn(36, 3)}, [36])
    exact = DesignValue(policy, qvalue, starts)(designs(100).float())
    fast = DesignValue(policy, qvalue, starts, precision="bfloat16")(designs(100).float())
    assert fast.dtype == torch.float32
    assert 0 < (fast - exact).abs().max() < 0.02 * exact.abs().max()
    assert exact[fast.argmax()] > exact.max() - 0.01 * exact.abs().max()  # what it chooses is as good
    assert all(p.dtype == torch.float32 for p in (*policy.parameters(), *qvalue.parameters()))


def test_closed_form():
    policy = TensorDictModule(lambda s, xi: s + xi, in_keys=["observation", "design"], out_keys=["action"])
    qvalue = TensorDictModule(
        lambda a, xi: torch.cat([a * xi, a + 100], -1), in_keys=["action", "design"], out_keys=["state_action_value"]
    )
    fitness = DesignValue(policy, qvalue, TensorDict({"observation": torch.tensor([[1.0], [3.0]])}, [2]))
    assert fitness(torch.tensor([[1.0], [2.0]])).tolist() == [3.0, 8.0]  # 1 (2 + 4) / 2, 2 (3 + 5) / 2


def test_it_is_differentiable_in_the_designs_and_in_nothing_else(parts):
    policy, qvalue, starts = parts
    fitness = DesignValue(policy, qvalue, starts)
    xi = designs(5).requires_grad_()
    assert torch.autograd.gradcheck(fitness, (xi,))
    fitness(xi).sum().backward()
    assert (xi.grad != 0).all()
    assert all(p.grad is None for p in (*policy.parameters(), *qvalue.parameters()))


def test_start_states_that_carry_a_graph_get_no_gradient(parts):
    policy, qvalue, starts = parts
    starts["observation"].requires_grad_()
    xi = designs(5).requires_grad_()
    DesignValue(policy, qvalue, starts)(xi).sum().backward()
    assert starts["observation"].grad is None
    assert (xi.grad != 0).all()


def test_moving_it_moves_networks_and_start_states(parts):
    policy, qvalue, starts = parts
    fitness = DesignValue(policy, qvalue, starts).float()
    for module in (fitness, policy, qvalue):
        assert {t.dtype for t in [*module.parameters(), *module.buffers()]} == {torch.float32}
    assert {value.dtype for value in fitness.start_states.values()} == {torch.float32}
    assert starts["observation"].dtype == torch.float64
    assert fitness(designs(5).float()).dtype == torch.float32


def test_it_follows_the_networks_as_they_train(parts):
    policy, qvalue, starts = parts
    fitness = DesignValue(policy, qvalue, starts)
    before = fitness(designs(5))
    qvalue.module.mlp.layers[-1].bias.data += 1.0
    torch.testing.assert_close(fitness(designs(5)), before + 1.0)


@pytest.mark.parametrize("wrapped", [False, True])  # asked on bare tensors, and as a TensorDict module
def test_the_action_is_deterministic_whatever_the_caller_explores(parts, wrapped):
    policy, qvalue, starts = parts
    fitness = DesignValue(TensorDictSequential(policy) if wrapped else policy, qvalue, starts)
    with set_exploration_type(ExplorationType.RANDOM):
        assert torch.equal(fitness(designs(5)), fitness(designs(5)))


def test_the_design_of_the_start_states_is_replaced(parts):
    policy, qvalue, starts = parts
    without = DesignValue(policy, qvalue, starts.select("observation"))
    assert torch.equal(DesignValue(policy, qvalue, starts)(designs(5)), without(designs(5)))


def test_a_tensordict_goes_in_and_comes_out(parts):
    fitness, rows = DesignValue(*parts), TensorDict({"design": designs(5)}, [5])
    assert torch.equal(fitness(rows)["design_value"], fitness(designs(5)))
    assert list(rows.keys()) == ["design"]


def test_nested_keys():
    policy = TensorDictModule(lambda xi: xi, in_keys=[("body", "xi")], out_keys=["action"])
    qvalue = TensorDictModule(lambda a, s: a + s, in_keys=["action", "observation"], out_keys=[("critic", "q")])
    fitness = DesignValue(policy, qvalue, TensorDict({"observation": torch.tensor([[1.0], [3.0]])}, [2]))
    fitness.set_keys(design=("body", "xi"), state_action_value=("critic", "q"))
    assert fitness(torch.tensor([[1.0]])).tolist() == [3.0]


def test_a_fleet_is_refused(toy_env, parts):
    with pytest.raises(ValueError, match="Policy was built with num_runs=7"):
        DesignValue(make_policy(toy_env, num_runs=7), *parts[1:])


def test_bad_input_is_named(parts):
    policy, qvalue, starts = parts
    fitness = DesignValue(policy, qvalue, starts)
    with pytest.raises(ValueError, match=r"designs of shape \[4, 3\] must be \[P, 2\]"):
        fitness(torch.ones(4, 3))
    with pytest.raises(ValueError, match=r"designs of shape \[2\] must be \[P, 2\]"):
        fitness(torch.ones(2))
    broken = designs(4)
    broken[2, 1] = torch.nan
    with pytest.raises(ValueError, match=r"designs \[2\] have NaN"):
        fitness(broken)
    with pytest.raises(ValueError, match=r"batch size \[0\]; give \[n\] rows of Replay_s0, at least one"):
        DesignValue(policy, qvalue, starts[:0])
    with pytest.raises(ValueError, match=r"batch size \[7, 1\]"):
        DesignValue(policy, qvalue, starts.unsqueeze(1))
    with pytest.raises(ValueError, match="chunk_size=0 must be at least 1"):
        DesignValue(policy, qvalue, starts, chunk_size=0)
    with pytest.raises(ValueError, match="precision='half' is unknown; choose 'float32' or 'bfloat16'"):
        DesignValue(policy, qvalue, starts, precision="half")
    starts["observation"][0, 0] = torch.inf
    with pytest.raises(ValueError, match=r"NaN or infinite entries in \['observation'\]"):
        DesignValue(policy, qvalue, starts)


def test_rows_that_a_buffer_overwrites_later_change_no_value(parts):
    fitness = DesignValue(*parts)
    before = fitness(designs(3))
    parts[-1]["observation"].fill_(9.0)
    assert torch.equal(fitness(designs(3)), before)


@pytest.fixture
def hopper_parts():
    """Hoppers, networks in float64, and start states of five bodies."""
    torch.manual_seed(0)
    env = HopperMorph(num_runs=5, seed=0)
    policy, qvalue = make_policy(env, num_cells=(8,)).double(), make_qvalue(env, num_cells=(8,)).double()
    starts = env.reset(TensorDict({"design": hoppers(5).float()}, [5])).select("observation", "design").double()
    return env, policy, qvalue, starts


def hoppers(count, seed=0):
    return 0.5 + 1.5 * torch.rand(count, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_matched_start_states_are_those_of_the_query(hopper_parts):
    env, policy, qvalue, starts = hopper_parts
    queries = hoppers(4, seed=1)
    matched = DesignValue(policy, qvalue, starts, start_states_are="matched", env=env)
    for query, value in zip(queries, matched(queries)):
        moved = env.transfer(starts["observation"], starts["design"], query)
        own = TensorDict({"observation": moved, "design": query.expand(5, -1)}, [5])
        torch.testing.assert_close(DesignValue(policy, qvalue, own)(query[None])[0], value)
    start = env.reset(TensorDict({"design": queries[:1].expand(5, -1).float()}, [5]))["observation"]
    moved = env.transfer(starts["observation"], starts["design"], queries[0])
    torch.testing.assert_close(moved[:, 0], start[:, 0].double(), atol=0.011, rtol=0)  # both with reset noise


def test_stored_start_states_stay_the_default_and_bodies_change_nothing_then(hopper_parts):
    env, policy, qvalue, starts = hopper_parts
    queries = hoppers(4, seed=1)
    plain = DesignValue(policy, qvalue, starts)(queries)
    assert torch.equal(DesignValue(policy, qvalue, starts, env=env)(queries), plain)
    matched = DesignValue(policy, qvalue, starts, start_states_are="matched", env=env)(queries)
    assert (matched - plain).abs().min() > 1e-6


def test_the_gradient_of_matched_states_sees_how_the_root_rises(hopper_parts):
    env, policy, qvalue, starts = hopper_parts
    queries = hoppers(3, seed=1).requires_grad_()
    matched = DesignValue(policy, qvalue, starts, start_states_are="matched", env=env)
    assert torch.autograd.gradcheck(matched, (queries,))
    (seen,) = torch.autograd.grad(matched(queries).sum(), queries)
    (unseen,) = torch.autograd.grad(DesignValue(policy, qvalue, starts)(queries).sum(), queries)
    assert not torch.allclose(seen, unseen)


def test_matched_states_are_the_same_for_networks_of_any_kind_and_in_chunks(hopper_parts):
    env, policy, qvalue, starts = hopper_parts
    queries = hoppers(7, seed=1)
    value = DesignValue(policy, qvalue, starts, start_states_are="matched", env=env)(queries)
    wrapped = [TensorDictSequential(module) for module in (policy, qvalue)]
    for chunk_size in (1, 3, None):
        other = DesignValue(*wrapped, starts, start_states_are="matched", env=env, chunk_size=chunk_size)
        torch.testing.assert_close(other(queries), value)


def test_matched_states_in_bfloat16_are_transferred_before_they_are_rounded(hopper_parts):
    env, policy, qvalue, starts = hopper_parts
    networks, starts, queries = (policy.float(), qvalue.float()), starts.float(), hoppers(6, seed=1).float()
    exact, rounded = (
        DesignValue(*networks, starts, start_states_are="matched", env=env, precision=precision)(queries)
        for precision in ("float32", "bfloat16")
    )
    torch.testing.assert_close(rounded, exact, atol=0.02, rtol=0.02)


def test_visited_states_can_stand_in_for_start_states(hopper_parts):
    env, policy, qvalue, _ = hopper_parts
    visited = transition_rows(env.rollout(20)).flatten().double()
    value = DesignValue(policy, qvalue, visited, start_states_are="matched", env=env)(hoppers(3))
    assert value.isfinite().all()


def test_states_that_cannot_be_matched_are_named(hopper_parts):
    env, policy, qvalue, starts = hopper_parts
    with pytest.raises(ValueError, match="start_states_are='moved' is unknown; choose 'stored' or 'matched'"):
        DesignValue(policy, qvalue, starts, start_states_are="moved")
    with pytest.raises(ValueError, match="pass env, or leave the states 'stored'"):
        DesignValue(policy, qvalue, starts, start_states_are="matched")
    with pytest.raises(TypeError, match=r"pass env\.base_env"):
        DesignValue(policy, qvalue, starts, start_states_are="matched", env=TransformedEnv(env))
    with pytest.raises(TypeError, match=r"a Tensor has no transfer\(\)"):
        DesignValue(policy, qvalue, starts, start_states_are="matched", env=torch.ones(1))
    bare = DesignValue(policy, qvalue, starts.select("observation"), start_states_are="matched", env=env)
    with pytest.raises(ValueError, match="start states to be matched lack 'design'"):
        bare(hoppers(2))


def test_designs_of_any_precision_are_asked_in_that_of_the_networks(hopper_parts):
    _, policy, qvalue, starts = hopper_parts
    fitness, queries = DesignValue(policy.float(), qvalue.float(), starts.float()), hoppers(3, seed=1)
    value = fitness(queries)
    assert value.dtype == torch.float64
    torch.testing.assert_close(value.float(), fitness(queries.float()), rtol=0, atol=1e-6)


def test_bodies_are_told_apart_by_states_alone_where_the_networks_do_not_read_the_design(hopper_parts):
    env, _, _, starts = hopper_parts
    policy = TensorDictModule(lambda seen: seen[..., :3], in_keys=["observation"], out_keys=["action"])
    qvalue = TensorDictModule(
        lambda seen, a: seen[..., :1], in_keys=["observation", "action"], out_keys=["state_action_value"]
    )
    matched = DesignValue(policy, qvalue, starts, start_states_are="matched", env=env)
    queries = hoppers(3, seed=1)
    heights = torch.stack([env.transfer(starts["observation"], starts["design"], xi)[:, 0].mean() for xi in queries])
    torch.testing.assert_close(matched(queries), heights)
