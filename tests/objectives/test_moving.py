"""Networks have their own weights again after a pass with others, however it ended."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.objectives import SoftUpdate

from coim import CoImSACLoss, DesignValue, EnsembleNLLLoss, GaussianEnsemble, HopperMorph, make_policy, make_qvalue
from coim import run_episode as play


@pytest.fixture(scope="module")
def rows() -> TensorDictBase:
    return play(HopperMorph(seed=0, episode_steps=10), None)[:, 0]


def design_value(rows: TensorDictBase) -> tuple[list, Callable[[], object]]:
    policy, qvalue = make_policy(HopperMorph(), num_cells=(8,)), make_qvalue(HopperMorph(), num_cells=(8,))
    value = DesignValue(policy, qvalue, rows)
    return [policy, qvalue], lambda: value(torch.ones(2, 4))


def sac_loss(rows: TensorDictBase) -> tuple[list, Callable[[], object]]:
    policy, qvalue = make_policy(HopperMorph(), num_cells=(8,)), make_qvalue(HopperMorph(), num_cells=(8,))
    loss = CoImSACLoss(policy, qvalue)
    SoftUpdate(loss, tau=0.1)
    with torch.no_grad():
        for weights in qvalue.parameters():
            weights.add_(1)  # learnt since: the targets are behind
    return [policy, qvalue], lambda: loss(rows.clone())


def dynamics_loss(rows: TensorDictBase) -> tuple[list, Callable[[], object]]:
    ensemble = GaussianEnsemble(11, 3, 4, num_cells=(8,))
    ensemble.update_statistics(rows)
    loss = EnsembleNLLLoss(ensemble)
    return [ensemble], lambda: loss(rows.clone())


@pytest.mark.parametrize("stopped_by", [ValueError, torch.OutOfMemoryError, KeyboardInterrupt])
@pytest.mark.parametrize("made", [design_value, sac_loss, dynamics_loss])
def test_an_error_in_a_pass_leaves_the_networks_their_weights(
    made: Callable, stopped_by: type[BaseException], rows: TensorDictBase, monkeypatch: pytest.MonkeyPatch
) -> None:
    networks, compute = made(rows)
    before = [[*network.named_parameters()] for network in networks]
    values = [[weights.clone() for _, weights in named] for named in before]

    def stop(*inputs: object) -> None:
        raise stopped_by("stopped")

    layer = next(part for part in networks[-1].modules() if not list(part.children()))
    layer.register_forward_pre_hook(stop)
    with pytest.raises(stopped_by, match="stopped"):
        compute()
    for network, named, were in zip(networks, before, values):
        after = [*network.named_parameters()]
        assert [name for name, _ in after] == [name for name, _ in named]
        assert all(now is then for (_, now), (_, then) in zip(after, named))
        assert all(torch.equal(now, value) for (_, now), value in zip(after, were))
