"""The gradients written out against autograd through `CoImSACLoss`, which defines them."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate
from toy_learners import sac_learner

from coim import CoImSACLoss, SACLearner
from coim.models.policy import LOG_SCALE_RANGE

Rows = Callable[..., TensorDict]
DOUBLE, SINGLE = torch.float64, torch.float32


def batch(make_rows: Rows, *shape: int, dtype: torch.dtype = DOUBLE, imagined: bool = True) -> TensorDict:
    """Rows with noise, and with a fifth of them imagined."""
    rows = make_rows(*shape, dtype=dtype)
    if imagined:
        rows["imagined"] = torch.rand(*shape, 1, generator=torch.Generator().manual_seed(5)) < 0.2
    return rows


def autograd(learner: SACLearner, rows: TensorDict, noise: list[torch.Tensor]) -> tuple[TensorDict, torch.Tensor]:
    """Losses, and the gradient in the order of the flat buffer, of a loss over copies of the learner's weights."""
    rows = rows.copy()
    rows["noise"], rows["next", "noise"] = noise
    for parameter in learner.loss.parameters():
        parameter.grad = None
    losses = learner.loss(rows)
    (losses["loss_actor"] + losses["loss_qvalue"]).backward()
    own = [*learner.policy.parameters(), *learner.qvalue.parameters()]
    return losses.detach(), torch.cat([parameter.grad.reshape(-1) for parameter in own])


def written_out(learner: SACLearner, rows: TensorDict, noise: list[torch.Tensor]) -> tuple[TensorDict, torch.Tensor]:
    """The same by the learner, which does not move: its learning rate is zero."""
    drawn = iter(noise)
    learner._noise = lambda action: next(drawn).unsqueeze(0)  # type: ignore[method-assign]
    losses = learner.update(rows.unsqueeze(0))
    return losses, learner._weights.grad.clone()


@pytest.mark.parametrize("mix", ["batch", "sum"])
@pytest.mark.parametrize("num_runs", [None, 3])
@pytest.mark.parametrize("num_critics", [1, 2, 3])
def test_gradients_and_losses_equal_autograd(make_rows: Rows, mix: str, num_runs: int | None, num_critics: int) -> None:
    subject = sac_learner(num_runs, mix=mix, num_critics=num_critics, lr=0.0, tau=1e-12)
    rows = batch(make_rows, 40, *([num_runs] if num_runs else []))
    noise = [torch.randn_like(rows["action"]) for _ in range(2)]
    losses, gradient = written_out(subject, rows, noise)
    expected_losses, expected = autograd(subject, rows, noise)
    torch.testing.assert_close(gradient, expected, rtol=1e-9, atol=1e-12)
    for key in ("loss_actor", "loss_qvalue"):
        torch.testing.assert_close(losses[key].sum(), expected_losses[key], rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(losses["entropy"].mean(), expected_losses["entropy"], rtol=1e-10, atol=1e-12)


def test_stacked_products_give_the_same_gradients_as_one_network_after_the_other(make_rows: Rows) -> None:
    """A GPU takes all runs in one product; the arithmetic can be tried on a CPU."""
    rows = batch(make_rows, 40, 3)
    noise = [torch.randn_like(rows["action"]) for _ in range(2)]
    one_by_one, stacked = (sac_learner(3, lr=0.0, tau=1e-12) for _ in range(2))
    stacked._cut_networks(one_by_one=False)
    assert len(one_by_one._networks) == 3
    assert len(stacked._networks) == 1
    expected, gradient = (written_out(subject, rows, noise) for subject in (one_by_one, stacked))
    torch.testing.assert_close(gradient[1], expected[1], rtol=1e-10, atol=1e-13)
    for key in ("loss_actor", "loss_qvalue", "entropy"):
        torch.testing.assert_close(gradient[0][key], expected[0][key], rtol=1e-10, atol=1e-13)


def test_a_clamped_log_scale_gets_no_gradient(make_rows: Rows) -> None:
    subject = sac_learner(lr=0.0, tau=1e-12)
    last = subject.policy.network.mlp.layers[-1]
    with torch.no_grad():
        last.bias[2:] += torch.tensor([LOG_SCALE_RANGE[1] + 5, 0.0], dtype=DOUBLE)
    rows = batch(make_rows, 40)
    noise = [torch.randn_like(rows["action"]) for _ in range(2)]
    gradient, expected = written_out(subject, rows, noise)[1], autograd(subject, rows, noise)[1]
    torch.testing.assert_close(gradient, expected, rtol=1e-6, atol=1e-9)
    size = last.bias.numel()
    end = sum(p.numel() for p in subject.policy.parameters())
    assert gradient[end - size : end][2] == 0
    assert gradient[end - size : end][3] != 0


@pytest.mark.parametrize("mix", ["batch", "sum"])
@pytest.mark.parametrize("imagined", [False, True])
@pytest.mark.parametrize(("dtype", "bound"), [(DOUBLE, 1e-9), (SINGLE, 1e-5)], ids=["float64", "float32"])
@pytest.mark.parametrize("num_runs", [None, 3])
def test_twenty_updates_end_where_the_loss_adam_and_soft_update_end(
    make_rows: Rows, mix: str, imagined: bool, dtype: torch.dtype, bound: float, num_runs: int | None
) -> None:
    subject, reference = (sac_learner(num_runs, dtype=dtype, mix=mix) for _ in range(2))
    loss = CoImSACLoss(reference.policy, reference.qvalue, mix=mix, num_runs=num_runs)  # type: ignore[arg-type]
    targets = SoftUpdate(loss, tau=0.005)
    optimiser = torch.optim.Adam(loss.parameters(), lr=3e-4)
    batches = batch(make_rows, 20, 40, *([num_runs] if num_runs else []), dtype=dtype, imagined=imagined)
    noise = [torch.randn_like(batches["action"]) for _ in range(2)]
    drawn = iter(noise)
    subject._noise = lambda action: next(drawn)  # type: ignore[method-assign]
    subject.update(batches)
    for rows, now, after in zip(batches, *noise):
        rows["noise"], rows["next", "noise"] = now, after
        losses = loss(rows)
        optimiser.zero_grad()
        (losses["loss_actor"] + losses["loss_qvalue"]).backward()
        optimiser.step()
        targets.step()
    for key, expected in loss.state_dict().items():
        actual = subject.loss.state_dict()[key]
        error = (actual - expected).norm() / expected.norm() if dtype == SINGLE else (actual - expected).abs().max()
        assert float(error) < bound, key


def test_bfloat16_products_stay_near_float32(make_rows: Rows) -> None:
    """Stated bounds: 1 % on each loss, 3 % on the whole gradient (in norm), weights still float32."""
    single, half = (sac_learner(dtype=SINGLE, lr=0.0, tau=1e-12, precision=p) for p in ("float32", "bfloat16"))
    rows = batch(make_rows, 256, dtype=SINGLE)
    noise = [torch.randn_like(rows["action"]) for _ in range(2)]
    expected, actual = (written_out(subject, rows, noise) for subject in (single, half))
    assert all(parameter.dtype == SINGLE for parameter in half.loss.parameters())
    for key in ("loss_actor", "loss_qvalue"):
        assert abs(float(actual[0][key] / expected[0][key]) - 1) < 0.01, key
    assert float((actual[1] - expected[1]).norm() / expected[1].norm()) < 0.03


def test_unknown_precision_and_tau_are_refused() -> None:
    with pytest.raises(ValueError, match="choose 'float32' or 'bfloat16'"):
        sac_learner(precision="float16")
    with pytest.raises(ValueError, match=r"tau=0 is outside \(0, 1\]"):
        sac_learner(tau=0)
