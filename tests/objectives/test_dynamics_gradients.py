"""The gradients written out against autograd through `EnsembleNLLLoss`, which defines them."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict

from coim import EnsembleNLLLoss, GaussianEnsemble
from coim.models.ensemble import LOG_VAR_RANGE
from coim.objectives.dynamics_gradients import DynamicsGradients, dynamics_gradients
from coim.objectives.gradients import Network

Rows = Callable[..., TensorDict]


def trained_on(rows: TensorDict, dtype: torch.dtype = torch.float64) -> GaussianEnsemble:
    torch.manual_seed(0)
    ensemble = GaussianEnsemble(3, 2, 2, num_members=3, num_cells=(16, 16)).to(dtype)
    ensemble.update_statistics(rows)
    return ensemble


def written_out(ensemble: GaussianEnsemble, rows: TensorDict, member: int | slice) -> DynamicsGradients:
    """Gradients of one member, or of all members stacked."""
    layers = [p.detach()[member] for p in ensemble.network.parameters()]
    x = ensemble.inputs(torch.cat([rows[key] for key in ("observation", "action", "design")], -1))
    target = ensemble.standardised_target(rows["observation"], rows["next", "observation"])
    if isinstance(member, slice):
        x, target = x.expand(3, -1, -1), target.expand(3, -1, -1)
    return dynamics_gradients(Network(layers[0::2], layers[1::2]), x, target, log_var_range=LOG_VAR_RANGE)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("raw", [None, -200.0, -12.0, -5.0, 5.0, 200.0])
def test_they_are_the_gradients_of_the_loss_of_each_member(make_rows: Rows, dtype: torch.dtype, raw: float) -> None:
    """Also far outside of the bounds of the log-variance, where its slope fades."""
    rows = make_rows(32, dtype=dtype)
    ensemble = trained_on(rows, dtype)
    if raw is not None:
        ensemble.network.layers[-1].bias.data[:, 3:] = raw
    loss = EnsembleNLLLoss(ensemble)(rows)["loss_dynamics"]
    loss.backward()
    stacked = written_out(ensemble, rows, slice(None))
    close = {"rtol": 1e-11, "atol": 1e-13} if dtype == torch.float64 else {"rtol": 1e-4, "atol": 1e-6}
    torch.testing.assert_close(stacked.loss.sum(), loss.detach(), rtol=1e-6, atol=0)
    for member in range(3):
        alone = written_out(ensemble, rows, member)
        torch.testing.assert_close(alone.loss, stacked.loss[member], rtol=1e-6, atol=0)
        for p, one, all_ in zip(ensemble.network.parameters(), alone.parameters, stacked.parameters, strict=True):
            scale = p.grad[member].abs().max()
            torch.testing.assert_close(one / scale, p.grad[member] / scale, **close)
            torch.testing.assert_close(all_[member] / scale, p.grad[member] / scale, **close)


def test_bfloat16_gradients_point_the_same_way(make_rows: Rows) -> None:
    rows = make_rows(256, dtype=torch.float32)
    ensemble = trained_on(rows, torch.float32)
    exact = written_out(ensemble, rows, 0)
    layers = [p.detach()[0].bfloat16() for p in ensemble.network.parameters()]
    x = ensemble.inputs(torch.cat([rows[key] for key in ("observation", "action", "design")], -1)).bfloat16()
    target = ensemble.standardised_target(rows["observation"], rows["next", "observation"])
    rounded = dynamics_gradients(Network(layers[0::2], layers[1::2]), x, target, log_var_range=LOG_VAR_RANGE)
    assert rounded.loss.dtype == torch.float32
    for ours, theirs in zip(rounded.parameters, exact.parameters):
        assert ours.dtype == torch.bfloat16
        assert (ours.float() - theirs).norm() < 0.02 * theirs.norm()
