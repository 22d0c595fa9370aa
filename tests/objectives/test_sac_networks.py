"""The loss with any networks: fleets, foreign ones, keys of their own, on the move, and what it refuses."""

import pytest
import torch
from sac_losses import build, foreign_networks, gradients, with_noise
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import SoftUpdate

from coim.models import make_policy, make_qvalue, select_run
from coim.objectives import CoImSACLoss


@pytest.mark.parametrize("foreign", [True, False])
def test_moving_the_loss_moves_networks_and_targets(policy, qvalue, make_rows, foreign):
    if foreign:
        policy, qvalue = foreign_networks()
    critics = qvalue if foreign else [qvalue]
    loss = CoImSACLoss(policy, qvalue)
    softly = SoftUpdate(loss, tau=0.25)
    parameters = list(loss.parameters())
    assert loss.float() is loss
    for module in (loss, policy, *critics):
        tensors = [*module.parameters(), *module.buffers()]
        assert {t.dtype for t in tensors if t.is_floating_point()} == {torch.float32}
    assert all(a is b for a, b in zip(parameters, loss.parameters(), strict=True))  # an optimiser may hold them
    held = {p.data_ptr() for p in loss.parameters()}
    assert held == {p.data_ptr() for module in (policy, *critics) for p in module.parameters()}
    rows = make_rows(8, dtype=torch.float32)
    out = loss(rows)
    assert out["loss_qvalue"].dtype == torch.float32
    (out["loss_actor"] + out["loss_qvalue"]).backward()
    torch.optim.SGD(loss.parameters(), lr=1.0).step()
    before = loss.target_qvalue_params.data.clone()
    softly.step()
    expected = before.lerp(loss.qvalue_params.data, 0.25)
    for key, target in loss.target_qvalue_params.items(True, True):
        torch.testing.assert_close(target, expected[key])


def test_nested_keys_and_foreign_networks(make_rows):
    policy, critics = foreign_networks(nested=True)
    rows = with_noise(make_rows(20))
    loss = build(policy, critics)
    loss.set_keys(
        action=("agent", "act"),
        design=("agent", "xi"),
        state_action_value=("agent", "q"),
        reward=("agent", "r"),
        terminated=("agent", "over"),
        imagined=("agent", "imagined"),
        noise=("agent", "eps"),
    )
    names = {"observation": "state", "design": "xi", "action": "act", "reward": "r", "terminated": "over"}
    names |= {"noise": "eps", "imagined": "imagined"}
    rows["imagined"] = torch.arange(20).unsqueeze(1) >= 15

    def renamed(td: TensorDict) -> TensorDict:
        return TensorDict({("agent", new): td[old] for old, new in names.items() if old in td}, td.batch_size)

    nested = renamed(rows).set("next", renamed(rows["next"]))
    assert set(loss.in_keys) == {
        ("agent", "state"),
        ("agent", "xi"),
        ("agent", "act"),
        ("next", "agent", "state"),
        ("next", "agent", "xi"),
        ("next", "agent", "r"),
        ("next", "agent", "over"),
    }
    flat_policy, flat_critics = foreign_networks()
    flat_policy.load_state_dict(policy.state_dict())
    for flat, critic in zip(flat_critics, critics):
        flat.load_state_dict(critic.state_dict())
    expected = build(flat_policy, flat_critics)(rows)
    assert (loss(nested) == expected).all()


def test_a_run_of_a_fleet_computes_what_it_computes_alone(toy_env, make_rows):
    rows = with_noise(make_rows(40, 3))
    rows["imagined"] = torch.rand(40, 3, 1) < 0.3
    policy = make_policy(toy_env, num_cells=(8, 8), num_runs=3).double()
    qvalue = make_qvalue(toy_env, num_cells=(8, 8), num_runs=3).double()
    for mix in ("batch", "sum"):
        alone = [build(select_run(policy, k), select_run(qvalue, k), mix=mix) for k in range(3)]
        fleet = build(policy, qvalue, mix=mix, num_runs=3)
        out, outs = fleet(rows), [loss(rows[:, k]) for k, loss in enumerate(alone)]
        grads = gradients(fleet, out)
        for key in ("loss_actor", "loss_qvalue"):
            torch.testing.assert_close(out[key], sum(o[key] for o in outs), rtol=1e-12, atol=1e-13)
        for k, loss in enumerate(alone):
            mine = gradients(loss, outs[k])
            for key in ("actor", "qvalue"):
                for ours, theirs in zip(mine[key], grads[key], strict=True):
                    torch.testing.assert_close(ours, theirs[k], rtol=1e-10, atol=1e-14)


def test_no_gradient_crosses_runs(toy_env, make_rows):
    policy = make_policy(toy_env, num_cells=(8,), num_runs=3).double()
    qvalue = make_qvalue(toy_env, num_cells=(8,), num_runs=3).double()
    loss, rows = build(policy, qvalue, num_runs=3), with_noise(make_rows(40, 3))
    before = gradients(loss, loss(rows))
    for key in ("observation", "design"):
        rows[key][:, 1] += 1.0
    after = gradients(loss, loss(rows))
    for key in ("actor", "qvalue"):
        for old, new in zip(before[key], after[key]):
            assert torch.equal(old[[0, 2]], new[[0, 2]])
            assert not torch.equal(old[1], new[1])


def test_targets_start_equal_and_follow_softly(policy, qvalue, make_rows):
    loss = CoImSACLoss(policy, qvalue)
    softly = SoftUpdate(loss, tau=0.25)
    loss(make_rows(4))
    bias = loss.qvalue_params["module", "mlp", "layers", "1", "bias"]
    target = loss.target_qvalue_params["module", "mlp", "layers", "1", "bias"]
    assert torch.equal(bias, target)
    start = bias.detach().clone()
    bias.data += 1.0
    softly.step()
    torch.testing.assert_close(target, start + 0.25)


def test_training_the_loss_trains_the_networks_given(policy, qvalue, make_rows):
    loss, rows = build(policy, qvalue), make_rows(50)
    before = [p.detach().clone() for p in (*policy.parameters(), *qvalue.parameters())]
    out = loss(rows)
    (out["loss_actor"] + out["loss_qvalue"]).backward()
    torch.optim.Adam(loss.parameters(), lr=1e-3).step()
    assert all(not torch.equal(a, b) for a, b in zip(before, (*policy.parameters(), *qvalue.parameters())))


def test_a_state_dict_brings_weights_and_targets_back(toy_env, policy, qvalue, make_rows):
    rows, loss = with_noise(make_rows(20)), build(policy, qvalue)
    other = build(make_policy(toy_env, num_cells=(8, 8)).double(), make_qvalue(toy_env, num_cells=(8, 8)).double())
    other.load_state_dict(loss.state_dict())
    assert (other(rows) == loss(rows)).all()


def test_it_can_be_called_with_tensors(policy, qvalue, make_rows):
    rows, loss = make_rows(20), build(policy, qvalue)
    tensors = {"_".join((key,) if isinstance(key, str) else key): rows[key] for key in loss.in_keys}
    torch.manual_seed(0)
    expected = loss(rows)
    torch.manual_seed(0)
    assert loss(**tensors) == tuple(expected[key] for key in loss.out_keys)


def test_noise_for_a_policy_that_is_no_tanh_normal_is_refused(policy, qvalue, make_rows):
    policy[-1].distribution_class = torch.distributions.Normal
    with pytest.raises(TypeError, match="noise is for TanhNormal policies, not Normal"):
        build(policy, qvalue)(with_noise(make_rows(4)))


def test_values_and_densities_that_are_not_one_per_row_are_refused(policy, qvalue, make_rows):
    # Broadcast, they would give a loss: of the least value in the batch, or of each row's reward with all densities.
    one = nn.Sequential(nn.Linear(2, 1), nn.Flatten(0)).double()
    flat = TensorDictModule(one, in_keys=["action"], out_keys=qvalue.out_keys)
    with pytest.raises(ValueError, match=r"the critics' values must be \[\*B, N\], .* \*B = \[4\], .* \*B = \[\]"):
        build(policy, flat, distinct_targets=False)(make_rows(4))
    policy[-1].distribution_class = torch.distributions.Normal
    with pytest.raises(ValueError, match=r"the policy's log-densities must be \[\*B\] with \*B = \[4\], .* = \[4, 2\]"):
        build(policy, qvalue)(make_rows(4))


def test_a_list_of_critics_that_is_none_is_refused(toy_env, policy):
    critic = make_qvalue(toy_env, num_critics=1)
    for critics in ([], [critic, critic]):
        with pytest.raises(ValueError, match=f"the list of {len(critics)} critics is empty or has one critic twice"):
            CoImSACLoss(policy, critics)
    fleet, alone = [make_policy(toy_env, num_runs=runs) for runs in (3, None)]
    others = [[make_qvalue(toy_env, num_critics=1, num_runs=runs) for _ in range(2)] for runs in (None, 3)]
    with pytest.raises(ValueError, match="num_runs=3, but QValue was built with num_runs=None"):
        CoImSACLoss(fleet, others[0], num_runs=3)
    with pytest.raises(ValueError, match="num_runs=None, but QValue was built with num_runs=3"):
        CoImSACLoss(alone, others[1])


def test_bad_input_is_named(toy_env, policy, qvalue, make_rows):
    with pytest.raises(ValueError, match="mix='mean' is unknown; choose 'batch' or 'sum'"):
        CoImSACLoss(policy, qvalue, mix="mean")
    with pytest.raises(ValueError, match="reduction='max' is unknown; choose 'mean', 'sum' or 'none'"):
        CoImSACLoss(policy, qvalue, reduction="max")
    with pytest.raises(ValueError, match="mix='sum' adds two means, and reduction='none' takes none"):
        CoImSACLoss(policy, qvalue, mix="sum", reduction="none")
    with pytest.raises(ValueError, match=r"gamma=1\.5 is outside \[0, 1\]"):
        CoImSACLoss(policy, qvalue, gamma=1.5)
    with pytest.raises(ValueError, match=r"alpha=-1 is below 0"):
        CoImSACLoss(policy, qvalue, alpha=-1)
    with pytest.raises(ValueError, match="num_runs=None, but Policy was built with num_runs=3"):
        CoImSACLoss(make_policy(toy_env, num_runs=3), qvalue)
    with pytest.raises(ValueError, match="not an accepted tensordict key"):
        build(policy, qvalue).set_keys(rewards="r")
    with pytest.raises(ValueError, match=r"size \[0\] has no rows"):
        build(policy, qvalue)(make_rows(0))
    with pytest.raises(KeyError, match="terminated"):
        build(policy, qvalue)(make_rows(4).exclude(("next", "terminated")))
