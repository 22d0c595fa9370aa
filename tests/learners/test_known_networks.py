"""Learners refuse networks whose gradients they would compute wrongly, and name the part."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import nn
from torchrl.envs import ExplorationType, set_exploration_type
from toy_env import ToyEnv

from coim import DesignValue, DynamicsLearner, GaussianEnsemble, SACLearner, make_policy, make_qvalue
from coim.models import Policy, PolicyNetwork, QValue
from coim.models.stacked import StackedMLP


class Doubled(PolicyNetwork):
    """Acts by twice the mean."""

    def forward(self, observation: torch.Tensor, design: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        loc, scale = super().forward(observation, design)
        return 2 * loc, scale


class Negated(Policy):
    """Does the opposite."""

    def forward(self, tensordict: Any) -> Any:
        tensordict = super().forward(tensordict)
        return tensordict.set("action", -tensordict["action"])


def networks() -> tuple[Policy, QValue]:
    return make_policy(ToyEnv(), num_cells=(8,)), make_qvalue(ToyEnv(), num_cells=(8,))


def other_activation(policy: Policy, qvalue: QValue) -> tuple[Policy, QValue]:
    mlp = policy.network.mlp
    policy.network.mlp = StackedMLP(mlp.in_features, mlp.out_features, (8,), activation=nn.ELU)
    return policy, qvalue


def other_network(policy: Policy, qvalue: QValue) -> tuple[Policy, QValue]:
    return Policy(Doubled(3, 2, 2, num_cells=(8,), scaling=policy.network.scaling)), qvalue


def other_policy(policy: Policy, qvalue: QValue) -> tuple[Policy, QValue]:
    return Negated(policy.network), qvalue


def other_forward(policy: Policy, qvalue: QValue) -> tuple[Policy, QValue]:
    qvalue.module.forward = lambda observation, action, design: action  # type: ignore[method-assign]
    return policy, qvalue


def other_layer(policy: Policy, qvalue: QValue) -> tuple[Policy, QValue]:
    qvalue.module.mlp.layers[0].register_forward_hook(lambda module, given, out: 2 * out)
    return policy, qvalue


def frozen_layer(policy: Policy, qvalue: QValue) -> tuple[Policy, QValue]:
    policy.network.mlp.layers[0].weight.requires_grad_(False)
    return policy, qvalue


def other_distribution(policy: Policy, qvalue: QValue) -> tuple[Policy, QValue]:
    policy[-1].distribution_kwargs = {"low": -2.0, "high": 2.0}
    return policy, qvalue


def bias_before_weight(policy: Policy, qvalue: QValue) -> tuple[Policy, QValue]:
    layer = qvalue.module.mlp.layers[1]
    weight = layer.weight
    del layer.weight
    layer.weight = weight
    return policy, qvalue


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (other_activation, "Policy.module.0.module.mlp.activation, a ELU, has a forward of its own"),
        (other_network, "Policy.module.0.module, a Doubled, has a forward of its own"),
        (other_policy, "Negated, a Negated, has a forward of its own"),
        (other_forward, "QValue.module, a QValueNetwork, has a forward of its own"),
        (other_layer, r"QValue.module.mlp.layers.0, a StackedLinear, has hooks; train it with CoImSACLoss"),
        (
            frozen_layer,
            r"trains all weights, and module.0.module.mlp.layers.0.weight of the Policy has requires_grad=Fal",
        ),
        (bias_before_weight, "registered in this order, and module.mlp.layers.1 has bias, weight in the QValue; train"),
        (other_distribution, r"a TanhNormal on \[-1, 1\], not of TanhNormal with {'low': -2.0, 'high': 2.0}"),
    ],
)
def test_policies_and_critics_that_compute_something_else_are_refused(
    change: Callable[..., tuple[Policy, QValue]], message: str
) -> None:
    with pytest.raises(TypeError, match=message):
        SACLearner(*change(*networks()))


def test_an_ensemble_that_computes_something_else_is_refused() -> None:
    ensemble = GaussianEnsemble.for_env(ToyEnv(), num_cells=(8,))
    ensemble.network.activation = nn.Tanh()
    with pytest.raises(TypeError, match=r"GaussianEnsemble\.network\.activation, a Tanh, .* with EnsembleNLLLoss"):
        DynamicsLearner(ensemble)


@pytest.mark.parametrize("change", [other_policy, other_network, other_forward, other_layer, other_distribution])
def test_designs_are_valued_by_what_the_networks_do_when_they_are_called(
    make_rows: Callable[..., Any], change: Callable[..., tuple[Policy, QValue]]
) -> None:
    rows, design = make_rows(7, dtype=torch.float32), torch.ones(1, 2)
    policy, qvalue = change(*networks())
    rows["design"] = design.expand(7, 2)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = qvalue(policy(rows.select("observation", "design")))["state_action_value"].amin(-1).mean()
    torch.testing.assert_close(DesignValue(policy, qvalue, rows)(design), expected.reshape(1))
