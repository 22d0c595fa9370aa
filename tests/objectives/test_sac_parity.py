"""The losses of TorchRL's SACLoss, value by value and gradient by gradient."""

import math

import pytest
import torch
from sac_losses import ALPHA, GAMMA, build, foreign_networks, gradients, with_noise
from tensordict import TensorDict
from torchrl.objectives import SACLoss, SoftUpdate

from coim.objectives import CoImSACLoss


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
