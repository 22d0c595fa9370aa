import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from coim.models import make_policy, make_qvalue, select_run
from coim.objectives import CoImSACLoss, functional

# Exact in float32, in which TorchRL keeps them.
ALPHA, GAMMA = 0.25, 0.9375


@pytest.fixture
def policy(toy_env):
    return make_policy(toy_env, num_cells=(8, 8)).double()


@pytest.fixture
def qvalue(toy_env):
    return make_qvalue(toy_env, num_cells=(8, 8)).double()


@pytest.fixture
def single_critics(toy_env):
    return [make_qvalue(toy_env, num_critics=1, num_cells=(8, 8)).double() for _ in range(2)]


def build(policy, qvalue, *, distinct_targets: bool = True, **kwargs) -> CoImSACLoss:
    """A loss whose target critics are followed and, by default, differ from the critics."""
    loss = CoImSACLoss(policy, qvalue, alpha=ALPHA, gamma=GAMMA, **kwargs)
    SoftUpdate(loss, tau=0.005)
    if distinct_targets:
        for target in loss.target_qvalue_params.values(True, True):
            target.data += 0.1
    return loss


def with_noise(rows: TensorDict, seed: int = 0) -> TensorDict:
    g = torch.Generator().manual_seed(seed)
    rows["next", "noise"], rows["noise"] = (
        torch.randn(rows["action"].shape, generator=g, dtype=rows["action"].dtype) for _ in range(2)
    )
    return rows


def foreign_networks(*, nested: bool = False):
    """A policy and two critics made of TorchRL's parts, with keys of their own where nested."""
    state, xi, act, q = (
        (("agent", "state"), ("agent", "xi"), ("agent", "act"), ("agent", "q"))
        if nested
        else ("observation", "design", "action", "state_action_value")
    )
    network = nn.Sequential(MLP(in_features=5, out_features=4, num_cells=[8]), NormalParamExtractor())
    both = TensorDictModule(lambda s, x: torch.cat([s, x], -1), in_keys=[state, xi], out_keys=["both"])
    module = TensorDictSequential(both, TensorDictModule(network, in_keys=["both"], out_keys=["loc", "scale"]))
    policy = ProbabilisticActor(
        module, in_keys=["loc", "scale"], out_keys=[act], distribution_class=TanhNormal, return_log_prob=True
    )
    critics = [
        ValueOperator(MLP(in_features=7, out_features=1, num_cells=[8]), in_keys=[state, act, xi], out_keys=[q])
        for _ in range(2)
    ]
    return policy.double(), [critic.double() for critic in critics]


def torchrl_loss(policy, critics, loss: CoImSACLoss, *, reduction: str = "mean") -> SACLoss:
    """TorchRL's loss with the same weights and targets as ``loss``, which was built on a list of these critics."""
    theirs = SACLoss(
        policy,
        critics,
        num_qvalue_nets=2,
        loss_function="l2",
        alpha_init=ALPHA,
        fixed_alpha=True,
        target_entropy=0.0,
        reduction=reduction,
        scalar_output_mode="non_tensor" if reduction == "none" else None,
    )
    theirs.make_value_estimator(gamma=GAMMA)
    theirs.double()
    theirs.log_alpha.data.fill_(math.log(ALPHA))
    SoftUpdate(theirs, tau=0.005)
    for target in theirs.target_qvalue_network_params.values(True, True):
        target.data += 0.1
    return theirs


def gradients(loss: nn.Module, out: TensorDict) -> dict[str, list[torch.Tensor]]:
    """Gradients of loss_actor and of loss_qvalue; a parameter without one is left out."""
    parameters = list(loss.parameters())
    both = (torch.autograd.grad(out[k], parameters, allow_unused=True) for k in ("loss_actor", "loss_qvalue"))
    return {key: [g for g in grads if g is not None] for key, grads in zip(("actor", "qvalue"), both)}


@pytest.mark.parametrize("foreign", [True, False])
@pytest.mark.parametrize("noise", ["seed", "key"])
def test_parity_with_torchrl(policy, single_critics, make_rows, noise, foreign):
    if foreign:
        policy, single_critics = foreign_networks()
    rows = make_rows(256)
    ours = build(policy, single_critics)
    theirs = torchrl_loss(policy, single_critics, ours)
    torch.manual_seed(0)
    expected = theirs(rows.clone())
    torch.manual_seed(0)
    if noise == "key":  # in the order of the losses: target first
        rows["next", "noise"], rows["noise"] = (torch.randn(256, 2, dtype=torch.float64) for _ in range(2))
    out = ours(rows)
    torch.testing.assert_close(out["loss_actor"], expected["loss_actor"], rtol=1e-14, atol=1e-15)
    torch.testing.assert_close(out["loss_qvalue"], 0.5 * expected["loss_qvalue"], rtol=1e-14, atol=1e-15)
    torch.testing.assert_close(out["entropy"], expected["entropy"], rtol=1e-14, atol=1e-15)
    mine, his = gradients(ours, out), gradients(theirs, expected)
    for a, b in zip(mine["actor"], his["actor"], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-15)
    half = len(mine["qvalue"]) // 2
    for first, second, both in zip(mine["qvalue"][:half], mine["qvalue"][half:], his["qvalue"], strict=True):
        torch.testing.assert_close(torch.stack([first, second]), 0.5 * both, rtol=1e-12, atol=1e-15)


def closed_form(policy, qvalue, loss: CoImSACLoss, rows: TensorDict) -> tuple[torch.Tensor, torch.Tensor]:
    """One number per row of Eq. 4 and Eq. 3, from tensor-level networks, the pure equations and the noise in rows."""
    s, xi, after = rows["observation"], rows["design"], rows["next"]
    action, log_prob = functional.tanh_normal(*policy.network(s, xi), rows["noise"])
    actor = functional.policy_loss(qvalue.module(s, action, xi), log_prob, ALPHA)
    action, log_prob = functional.tanh_normal(*policy.network(after["observation"], xi), after["noise"])
    with torch.no_grad(), loss.target_qvalue_params.to_module(qvalue):
        value = functional.soft_value(qvalue.module(after["observation"], action, xi), log_prob, ALPHA)
    target = functional.bellman_target(after["reward"][..., 0], after["terminated"][..., 0], value, GAMMA)
    return actor, functional.qvalue_loss(qvalue.module(s, rows["action"], xi), target.detach())


def test_it_is_eq_3_and_4_when_nothing_is_imagined(policy, qvalue, make_rows):
    rows, loss = with_noise(make_rows(50)), build(policy, qvalue)
    actor, critics = closed_form(policy, qvalue, loss, rows)
    out = loss(rows)
    torch.testing.assert_close(out["loss_actor"], actor.mean(), rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(out["loss_qvalue"], critics.mean(), rtol=1e-12, atol=1e-13)
    assert set(out.keys()) == set(loss.out_keys)
    assert not out["entropy"].requires_grad


@pytest.mark.parametrize(
    ("mix", "weights"), [("batch", [1 / 256] * 256), ("sum", [1 / 205] * 205 + [1 / 51] * 51)], ids=["batch", "sum"]
)
def test_imagined_rows_count_once(policy, qvalue, make_rows, mix, weights):
    rows, loss = with_noise(make_rows(256)), build(policy, qvalue, mix=mix)
    rows["imagined"] = torch.arange(256).unsqueeze(1) >= 205
    out, weights = loss(rows), torch.tensor(weights, dtype=torch.float64)
    for key, per_row in zip(("loss_actor", "loss_qvalue"), closed_form(policy, qvalue, loss, rows)):
        torch.testing.assert_close(out[key], (weights * per_row).sum(), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("mix", ["batch", "sum"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.int64, torch.uint8], ids=str)
def test_marks_of_imagined_rows_may_be_numbers(policy, qvalue, make_rows, mix, dtype):
    rows = make_rows(40)
    rows["imagined"], rows["weight"] = torch.arange(40).unsqueeze(1) >= 30, torch.rand(40, 1)
    losses = []
    for marks in (rows["imagined"], rows["imagined"].to(dtype)):
        torch.manual_seed(0)
        losses.append(build(policy, qvalue, mix=mix)(rows.clone().set("imagined", marks)))
    assert all(torch.equal(losses[0][name], losses[1][name]) for name in ("loss_actor", "loss_qvalue"))


@pytest.mark.parametrize("imagined", [None, False, True])
def test_with_one_kind_of_row_both_mixes_agree(policy, qvalue, make_rows, imagined):
    rows = with_noise(make_rows(50))
    if imagined is not None:
        rows["imagined"] = torch.full((50, 1), imagined)
    batch, summed = (build(policy, qvalue, mix=mix)(rows) for mix in ("batch", "sum"))
    torch.testing.assert_close(batch["loss_qvalue"], summed["loss_qvalue"], rtol=1e-13, atol=0)


def test_who_gets_gradient(policy, qvalue, make_rows):
    loss = build(policy, qvalue)
    out = loss(make_rows(20))
    table = {
        (name, part)
        for name in ("loss_actor", "loss_qvalue")
        for part in ("policy_params", "qvalue_params", "target_qvalue_params")
        if any(
            g is not None and g.any()
            for g in torch.autograd.grad(
                out[name],
                [p for p in getattr(loss, part).values(True, True) if p.requires_grad] or [nn.Parameter(torch.ones(1))],
                retain_graph=True,
                allow_unused=True,
            )
        )
    }
    assert table == {("loss_actor", "policy_params"), ("loss_qvalue", "qvalue_params")}
    assert not any(p.requires_grad for p in loss.target_qvalue_params.values(True, True))


def test_only_terminated_cuts_the_bootstrap(policy, qvalue, make_rows):
    loss, rows = build(policy, qvalue), with_noise(make_rows(20))
    values = {}
    for flag in ("terminated", "truncated", "done"):
        for ends in (False, True):
            changed = rows.clone()
            changed["next", "terminated"][:] = False
            changed["next", flag][:] = ends
            values[flag, ends] = loss(changed)["loss_qvalue"].item()
    assert values["truncated", True] == values["truncated", False] == values["done", True]
    q = qvalue.module(rows["observation"], rows["action"], rows["design"])
    without_future = functional.qvalue_loss(q, rows["next", "reward"].squeeze(-1)).mean()
    assert values["terminated", True] == pytest.approx(without_future.item(), rel=1e-12)
    assert values["terminated", True] != values["terminated", False]


def test_the_error_is_written_into_the_input_and_nothing_else(policy, qvalue, make_rows):
    rows = with_noise(make_rows(20))
    before = rows.clone()
    build(policy, qvalue)(rows)
    assert set(rows.keys(True)) == {*before.keys(True), "td_error"}
    assert (rows.exclude("td_error") == before).all()


def prioritised(make_rows, *, num: int = 256) -> TensorDict:
    """Rows as TorchRL's prioritised replay and n-step transform hand them out."""
    rows, g = with_noise(make_rows(num)), torch.Generator().manual_seed(0)
    rows["steps_to_next_obs"] = torch.randint(1, 6, (num, 1), generator=g)
    return rows.set("priority_weight", torch.rand(num, generator=g, dtype=torch.float64) + 0.1)


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_prioritised_n_step_rows_count_as_in_torchrl(policy, single_critics, make_rows, reduction):
    rows = prioritised(make_rows).exclude("noise", ("next", "noise"))
    ours = build(policy, single_critics, reduction=reduction)
    theirs = torchrl_loss(policy, single_critics, ours, reduction=reduction)
    given = rows.clone()
    torch.manual_seed(0)
    expected = theirs(given)
    torch.manual_seed(0)
    out = ours(rows)
    torch.testing.assert_close(out["loss_actor"], expected["loss_actor"], rtol=1e-13, atol=1e-14)
    torch.testing.assert_close(out["loss_qvalue"], 0.5 * expected["loss_qvalue"], rtol=1e-13, atol=1e-14)
    torch.testing.assert_close(rows["td_error"], given["td_error"], rtol=1e-13, atol=1e-14)
    assert not rows["td_error"].requires_grad
    assert list(out.batch_size) == ([256] if reduction == "none" else [])


def test_three_steps_ahead_the_future_counts_gamma_cubed(policy, qvalue, make_rows):
    loss, rows = build(policy, qvalue), with_noise(make_rows(20))
    rows["steps_to_next_obs"] = torch.full((20, 1), 3)
    nearer = with_noise(make_rows(20))
    cubed = CoImSACLoss(policy, qvalue, alpha=ALPHA, gamma=GAMMA**3)
    SoftUpdate(cubed, tau=0.005)
    cubed.target_qvalue_params.data.copy_(loss.target_qvalue_params.data)
    assert loss(rows)["loss_qvalue"].item() == pytest.approx(cubed(nearer)["loss_qvalue"].item(), rel=1e-12)


def test_importance_weights_are_shares_of_each_mean_of_each_run(toy_env, make_rows):
    rows = with_noise(make_rows(40, 3))
    rows["imagined"] = torch.arange(40).reshape(40, 1, 1).expand(40, 3, 1) >= 30
    rows["priority_weight"] = torch.rand(40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) + 0.1
    policy = make_policy(toy_env, num_cells=(8,), num_runs=3).double()
    qvalue = make_qvalue(toy_env, num_cells=(8,), num_runs=3).double()
    for mix in ("batch", "sum"):
        out, expected = build(policy, qvalue, mix=mix, num_runs=3)(rows)["loss_qvalue"], 0.0
        for k in range(3):
            alone = build(select_run(policy, k), select_run(qvalue, k), reduction="none")
            weight, imagined = rows["priority_weight"][:, k], rows["imagined"][:, k, 0]
            weighted = alone(rows[:, k])["loss_qvalue"]  # each row times its weight
            parts = [imagined | ~imagined] if mix == "batch" else [imagined, ~imagined]
            expected += sum(weighted[part].sum() / weight[part].sum() for part in parts)
        torch.testing.assert_close(out, expected, rtol=1e-12, atol=0)


def test_the_priority_goes_where_set_keys_says(policy, qvalue, make_rows):
    loss, rows = build(policy, qvalue), make_rows(8)
    loss.set_keys(priority=("replay", "error"), priority_weight=("replay", "weight"))
    loss(rows)
    assert rows["replay", "error"].shape == (8,)


@pytest.mark.parametrize("name", ["loss_actor", "loss_qvalue"])
def test_rows_that_carry_a_graph_get_no_gradient(policy, qvalue, make_rows, name):
    rows, sources = with_noise(make_rows(20)), []
    for key, value in list(rows.items(True, True)):
        if value.is_floating_point():
            sources.append(value.clone().requires_grad_())
            rows[key] = sources[-1] * 1.0
    loss = build(policy, qvalue)
    loss(rows)[name].backward()
    assert all(source.grad is None for source in sources)
    own, other = (qvalue, policy) if name == "loss_qvalue" else (policy, qvalue)
    assert any(p.grad is not None and p.grad.any() for p in own.parameters())
    assert all(p.grad is None for p in other.parameters())


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


def test_an_absent_next_design_is_the_design(policy, qvalue, make_rows):
    rows, loss = with_noise(make_rows(20)), build(policy, qvalue)
    assert loss(rows.exclude(("next", "design")))["loss_qvalue"] == loss(rows)["loss_qvalue"]


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


@pytest.mark.parametrize("batch", [(1,), (6,), (6, 1)])
def test_a_number_of_a_row_needs_no_dimension_of_its_own(policy, qvalue, make_rows, batch):
    loss, rows = build(policy, qvalue, mix="sum"), with_noise(make_rows(*batch))
    rows["imagined"] = torch.arange(len(rows)).reshape(*batch, 1) % 2 == 1
    expected = loss(rows.clone())
    for key in ("imagined", ("next", "reward"), ("next", "terminated")):
        rows[key] = rows[key].squeeze(-1)
    assert (loss(rows) == expected).all()


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
