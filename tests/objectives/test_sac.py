"""The losses, term by term: what imagined rows count, what cuts the bootstrap, who gets gradient."""

import pytest
import torch
from sac_losses import ALPHA, GAMMA, build, with_noise
from tensordict import TensorDict
from torch import nn
from torchrl.objectives import SoftUpdate

from coim.models import make_policy, make_qvalue, select_run
from coim.objectives import CoImSACLoss, functional


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


def test_an_absent_next_design_is_the_design(policy, qvalue, make_rows):
    rows, loss = with_noise(make_rows(20)), build(policy, qvalue)
    assert loss(rows.exclude(("next", "design")))["loss_qvalue"] == loss(rows)["loss_qvalue"]


@pytest.mark.parametrize("batch", [(1,), (6,), (6, 1)])
def test_a_number_of_a_row_needs_no_dimension_of_its_own(policy, qvalue, make_rows, batch):
    loss, rows = build(policy, qvalue, mix="sum"), with_noise(make_rows(*batch))
    rows["imagined"] = torch.arange(len(rows)).reshape(*batch, 1) % 2 == 1
    expected = loss(rows.clone())
    for key in ("imagined", ("next", "reward"), ("next", "terminated")):
        rows[key] = rows[key].squeeze(-1)
    assert (loss(rows) == expected).all()
