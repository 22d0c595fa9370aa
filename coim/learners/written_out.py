"""What the gradients written out in `coim.objectives` are right for: networks of `coim.models` as they were made, and
rows of single steps that count alike.
"""

from __future__ import annotations

from dataclasses import asdict

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import SafeProbabilisticModule, TanhNormal

from coim.calling import altered_part
from coim.models.ensemble import GaussianEnsemble
from coim.models.normaliser import RunningNormaliser
from coim.models.policy import Policy, PolicyNetwork
from coim.models.qvalue import QValue, QValueNetwork
from coim.models.scaling import InputScaling
from coim.models.stacked import StackedLinear, StackedMLP
from coim.objectives.dynamics import check_one_step
from coim.objectives.sac import CoImSACLoss

STACKED = (nn.ModuleList, StackedMLP, StackedLinear)
SAC = (Policy, PolicyNetwork, QValue, QValueNetwork, TensorDictModule, SafeProbabilisticModule, InputScaling)
OF_SAC, OF_ENSEMBLE = (*STACKED, *SAC, nn.ReLU), (*STACKED, GaussianEnsemble, RunningNormaliser, nn.SiLU)


def check_sac_networks(policy: Policy, qvalue: QValue) -> None:
    """Refuse a policy or critics that compute something else, or do not see the same numbers.

    Raises:
        TypeError: naming the part that is another, or a weight that must not be trained.
        ValueError: if the two scale their inputs differently, or are on other devices or in other dtypes.
    """
    for network in (policy, qvalue):
        _check_parts(network, OF_SAC, "SACLearner", "CoImSACLoss")
    distribution, settings = policy[-1].distribution_class, policy[-1].distribution_kwargs
    if distribution is not TanhNormal or settings:
        raise TypeError(
            f"SACLearner knows the gradients of a TanhNormal on [-1, 1], not of {distribution.__name__} with "
            f"{settings}; train it with CoImSACLoss and an optimiser"
        )
    kinds = {(weights.device, weights.dtype) for network in (policy, qvalue) for weights in network.parameters()}
    if len(kinds) > 1:
        found = " and ".join(sorted(f"{dtype} on {device}" for device, dtype in kinds))
        raise ValueError(f"the weights of policy and qvalue are {found}; move both to one device and dtype first")
    if not _same_scaling(policy.network.scaling, qvalue.module.scaling):
        raise ValueError("policy and qvalue scale their inputs differently; make both for the same environment")


def check_exchangeable(own: tuple[Policy, QValue], others: tuple[Policy, QValue]) -> None:
    """Refuse two learners of which one cannot take the weights of the other, or would mean something else by them.

    Raises:
        ValueError: if their layers or their scalings differ.
    """
    pairs: list[tuple[nn.Module, nn.Module]] = list(zip(own, others, strict=True))
    for network, other in pairs:
        layers, theirs = ([list(weights.shape) for weights in module.parameters()] for module in (network, other))
        if layers != theirs:
            raise ValueError(
                f"the {type(network).__name__} of one learner has weights of shapes {layers}, that of the other "
                f"{theirs}; make both with the same sizes, so that one can start from the other"
            )
    if not _same_scaling(own[0].network.scaling, others[0].network.scaling):
        raise ValueError(
            "the two learners scale their inputs differently, and weights of one mean something else in the other; "
            "make both for the same environment"
        )


def check_sac_rows(rows: TensorDictBase, keys: CoImSACLoss._AcceptedKeys) -> None:
    """Refuse rows of which `CoImSACLoss` takes something into account that the gradients written out do not.

    Args:
        rows: ``[*B]``.
        keys: those of the loss.

    Raises:
        ValueError: naming the key.
    """
    schema = asdict(CoImSACLoss.default_keys())
    renamed = {name: key for name, key in asdict(keys).items() if key != schema[name] and name != "priority"}
    if renamed:
        raise ValueError(f"SACLearner reads rows by the keys of the schema, not by {renamed}; rename their entries")
    check_one_step(rows, keys.steps_to_next_obs)
    if keys.priority_weight in rows.keys(True):
        raise ValueError(
            f"rows with {keys.priority_weight!r}: SACLearner has no importance weights; train with CoImSACLoss, or "
            "exclude() the key to count all rows alike"
        )


def check_ensemble(ensemble: GaussianEnsemble) -> None:
    """Refuse an ensemble that computes something else.

    Raises:
        TypeError: naming the part that is another, or a weight that must not be trained.
    """
    _check_parts(ensemble, OF_ENSEMBLE, "DynamicsLearner", "EnsembleNLLLoss")


def _check_parts(network: nn.Module, kinds: tuple[type[nn.Module], ...], learner: str, loss: str) -> None:
    altered = altered_part(network, kinds)
    if altered is not None:
        raise TypeError(
            f"{learner} knows the gradients of the networks of coim.models alone, and {altered}; train it with {loss} "
            "and an optimiser"
        )
    frozen = [name for name, parameter in network.named_parameters() if not parameter.requires_grad]
    if frozen:
        raise TypeError(
            f"{learner} trains all weights, and {frozen[0]} of the {type(network).__name__} has requires_grad=False; "
            f"train the others with {loss} and an optimiser"
        )


def _same_scaling(one: InputScaling | None, other: InputScaling | None) -> bool:
    """Whether two networks see the same numbers."""
    if one is None or other is None:
        return one is other
    return all(torch.equal(a.to(b), b) for a, b in zip(one.buffers(), other.buffers(), strict=True))
