"""Losses of small networks, and their gradients."""

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SoftUpdate

from coim.objectives import CoImSACLoss

# Exact in float32, in which TorchRL keeps them.
ALPHA, GAMMA = 0.25, 0.9375


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


def gradients(loss: nn.Module, out: TensorDict) -> dict[str, list[torch.Tensor]]:
    """Gradients of loss_actor and of loss_qvalue; a parameter without one is left out."""
    parameters = list(loss.parameters())
    both = (torch.autograd.grad(out[k], parameters, allow_unused=True) for k in ("loss_actor", "loss_qvalue"))
    return {key: [g for g in grads if g is not None] for key, grads in zip(("actor", "qvalue"), both)}
