"""Networks that the learners know the gradients of: those of `coim.models`, as they were made.

`coim.objectives.gradients` and `coim.objectives.dynamics_gradients` compute the gradients of these networks and of no
others. A network that computes something else would be trained wrongly in silence, so it is refused.
"""

from __future__ import annotations

import torch
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

STACKED = (nn.ModuleList, StackedMLP, StackedLinear)
SAC = (Policy, PolicyNetwork, QValue, QValueNetwork, TensorDictModule, SafeProbabilisticModule, InputScaling)
OF_SAC, OF_ENSEMBLE = (*STACKED, *SAC, nn.ReLU), (*STACKED, GaussianEnsemble, RunningNormaliser, nn.SiLU)


def check_sac_networks(policy: Policy, qvalue: QValue) -> None:
    """Refuse a policy or critics that compute something else, or that scale their inputs differently.

    Raises:
        TypeError: if a part computes something else, or a weight must not be trained; the message names it.
        ValueError: if the two differ in the scaling of their inputs, in device or in dtype.
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
    """Refuse two learners that cannot start from each other's weights.

    Args:
        own: policy and critics of one learner.
        others: policy and critics of the other.

    Raises:
        ValueError: if their layers differ, or the scaling of their inputs: the same weights would then mean something
            else.
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


def check_ensemble(ensemble: GaussianEnsemble) -> None:
    """Refuse an ensemble that computes something else.

    Raises:
        TypeError: if a part computes something else, or a weight must not be trained; the message names it.
    """
    _check_parts(ensemble, OF_ENSEMBLE, "DynamicsLearner", "EnsembleNLLLoss")


def _check_parts(network: nn.Module, kinds: tuple[type[nn.Module], ...], learner: str, loss: str) -> None:
    altered = altered_part(network, kinds)
    if altered is not None:
        raise TypeError(
            f"{learner} knows the gradients of the networks of coim.models alone, and {altered}; train it with {loss} "
            "and an optimiser"
        )
    odd = [
        f"{name} has {', '.join(held)}"
        for name, part in network.named_modules()
        if isinstance(part, StackedLinear) and (held := [*dict(part.named_parameters())]) != ["weight", "bias"]
    ]
    if odd:  # it reads all parameters in their order
        raise TypeError(
            f"{learner} trains layers that have a weight and a bias, registered in this order, and {odd[0]} in the "
            f"{type(network).__name__}; train it with {loss} and an optimiser"
        )
    frozen = [name for name, parameter in network.named_parameters() if not parameter.requires_grad]
    if frozen:
        raise TypeError(
            f"{learner} trains all weights, and {frozen[0]} of the {type(network).__name__} has requires_grad=False; "
            f"train the others with {loss} and an optimiser"
        )


def _same_scaling(one: InputScaling | None, other: InputScaling | None) -> bool:
    """Whether two scalings make the same numbers of the same inputs."""
    if one is None or other is None:
        return one is other
    return all(torch.equal(a.to(b), b) for a, b in zip(one.buffers(), other.buffers(), strict=True))
