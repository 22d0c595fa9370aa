r"""The gradients of Eq. 7-8, written out: the same as those of `CoImSACLoss` by autograd, in less time.

The policy evaluates both states in one product, and the critics both actions. Only the gradients that an optimiser
needs are computed, and no graph is recorded. This is what `coim.SACLearner` trains with. `CoImSACLoss` is the
definition; ``tests/objectives/test_gradients.py`` holds the two equal.

Shapes: B batch, K runs (leading where networks are stacked along them), N critics, S observation, D design, A action.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Eq. 3, 4, 7, 8.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from coim.objectives.functional import bellman_target, policy_loss, qvalue_loss, soft_value, tanh_normal
from coim.products import affine, input_gradient, weight_gradient


class Network(NamedTuple):
    """A ReLU network as bare tensors: weights ``[(K,) F, O]`` and biases ``[(K,) O]`` of its layers."""

    weights: Sequence[Tensor]
    biases: Sequence[Tensor]


class Batch(NamedTuple):
    """Transitions as bare tensors, ``[(K,) B, ...]``, with the noise of the two actions and the weight of each row."""

    observation: Tensor
    design: Tensor
    action: Tensor
    next_observation: Tensor
    reward: Tensor
    terminated: Tensor
    noise: Tensor
    next_noise: Tensor
    weight: Tensor


class SACGradients(NamedTuple):
    """Gradients of the policy and of each critic (weight, bias, weight, bias, ...); losses and entropy, ``[(K)]``."""

    policy: list[Tensor]
    critics: list[list[Tensor]]
    loss_actor: Tensor
    loss_qvalue: Tensor
    entropy: Tensor


def forward(network: Network, x: Tensor) -> list[Tensor]:
    """Input, hidden activations and output of a ReLU network, in the dtype of its weights."""
    activations = [x.to(network.weights[0].dtype)]
    last = len(network.weights) - 1
    for i, (weight, bias) in enumerate(zip(network.weights, network.biases)):
        activations.append(affine(activations[-1], weight, bias, "none" if i == last else "relu"))
    return activations


def deltas(network: Network, activations: Sequence[Tensor], delta: Tensor) -> list[Tensor]:
    """Gradients of the pre-activations of all layers, first layer first, from the gradient of the output."""
    found = [delta.to(network.weights[0].dtype)]
    for weight, activation in zip(reversed(network.weights[1:]), reversed(activations[1:-1])):
        found.append(torch.ops.aten.threshold_backward(input_gradient(found[-1], weight), activation, 0.0))
    return found[::-1]


def parameter_gradients(activations: Sequence[Tensor], delta: Sequence[Tensor]) -> list[Tensor]:
    """Weight and bias gradient of each layer, in the order weight, bias, weight, bias, ..."""
    return [g for x, d in zip(activations, delta) for g in (weight_gradient(x, d), d.sum(-2))]


def sac_gradients(
    policy: Network,
    critics: Sequence[Network],
    targets: Sequence[Network],
    batch: Batch,
    *,
    alpha: float | Tensor,
    gamma: float | Tensor,
    log_scale_range: tuple[float, float],
) -> SACGradients:
    """Losses of Eq. 7-8 and their gradients.

    Args:
        policy: maps ``[(K,) B, S + D]`` to ``[(K,) B, 2 A]``, loc and unclamped log-scale.
        critics: N networks, each mapping ``[(K,) B, S + A + D]`` to ``[(K,) B, 1]``.
        targets: the N target critics.
        batch: its weights are those of `coim.objectives.functional.mixing_weights`. Where the networks' weights are
            bfloat16, products are too; the output of a network is cast back to the dtype of the batch.
        alpha: entropy temperature; a scalar tensor if it changes after compilation.
        gamma: discount, likewise.
        log_scale_range: bounds to which the log-scale is clamped.
    """
    size, num_actions = batch.observation.shape[-2], batch.action.shape[-1]
    states = torch.cat([batch.observation, batch.next_observation], -2)
    states = torch.cat([states, torch.cat([batch.design, batch.design], -2)], -1)
    policy_activations = forward(policy, states)
    loc, raw = policy_activations[-1].to(states.dtype).split(num_actions, -1)
    scale = raw.clamp(*log_scale_range).exp()
    action, log_prob = tanh_normal(loc, scale, torch.cat([batch.noise, batch.next_noise], -2))
    new_action, next_action = action.split(size, -2)
    new_log_prob, next_log_prob = log_prob.split(size, -1)

    after = torch.cat([batch.next_observation, next_action, batch.design], -1)
    next_q = torch.cat([forward(target, after)[-1] for target in targets], -1).to(after.dtype)
    target = bellman_target(batch.reward, batch.terminated, soft_value(next_q, next_log_prob, alpha), gamma)

    actions = torch.cat([batch.action, new_action], -2)
    now = torch.cat([torch.cat([batch.observation] * 2, -2), actions, torch.cat([batch.design] * 2, -2)], -1)
    critic_activations = [forward(critic, now) for critic in critics]
    stored_q, new_q = torch.cat([a[-1] for a in critic_activations], -1).to(now.dtype).split(size, -2)

    # dJ_Q/dQ at the stored actions, and dJ_pi/dQ at the policy's: the smallest critic gets it, equal ones share it.
    weight = batch.weight.unsqueeze(-1)
    smallest = (new_q == new_q.amin(-1, keepdim=True)).to(new_q.dtype)
    share = smallest / smallest.sum(-1, keepdim=True)
    error = torch.cat([(stored_q - target.unsqueeze(-1)) * weight, -weight * share], -2)
    critic_gradients, action_gradient = [], torch.zeros_like(new_action)
    for n, (critic, activations) in enumerate(zip(critics, critic_activations)):
        delta = deltas(critic, activations, error[..., n : n + 1])
        stored = [a[..., :size, :] for a in activations], [d[..., :size, :] for d in delta]
        critic_gradients.append(parameter_gradients(*stored))
        num_observations = batch.observation.shape[-1]
        of_action = critic.weights[0][..., num_observations : num_observations + num_actions, :]
        action_gradient += input_gradient(delta[0][..., size:, :], of_action)

    # Through the tanh: da/du = 1 - a^2 and d log_prob/du = 2 a at fixed noise; log_prob falls with the log-scale.
    entropy_weight = alpha * weight
    of_preimage = action_gradient * (1 - new_action.square()) + 2 * entropy_weight * new_action
    of_log_scale = of_preimage * scale[..., :size, :] * batch.noise - entropy_weight
    low, high = log_scale_range
    own_raw = raw[..., :size, :]
    of_log_scale = of_log_scale * ((own_raw >= low) & (own_raw <= high))
    own = [a[..., :size, :] for a in policy_activations]
    policy_deltas = deltas(policy, own, torch.cat([of_preimage, of_log_scale], -1))
    return SACGradients(
        policy=parameter_gradients(own, policy_deltas),
        critics=critic_gradients,
        loss_actor=(policy_loss(new_q, new_log_prob, alpha) * batch.weight).sum(-1),
        loss_qvalue=(qvalue_loss(stored_q, target) * batch.weight).sum(-1),
        entropy=-new_log_prob.mean(-1),
    )
