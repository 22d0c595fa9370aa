r"""The gradients of Eq. 6, written out: the same as those of `EnsembleNLLLoss` by autograd, in less time.

This is what `coim.DynamicsLearner` trains with. `EnsembleNLLLoss` is the definition;
``tests/objectives/test_dynamics_gradients.py`` holds the two equal.

Shapes: B batch, G members (of all runs, leading where networks are stacked along them), F input features, S state.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Eq. 6.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import silu, softplus

from coim.objectives.functional import gaussian_nll
from coim.objectives.gradients import Network, parameter_gradients
from coim.products import affine, input_gradient


class DynamicsGradients(NamedTuple):
    """Gradients of weight, bias, weight, bias, ... layer by layer, and J_p of Eq. 6, ``[(G)]``."""

    parameters: list[Tensor]
    loss: Tensor


def dynamics_gradients(
    network: Network, x: Tensor, target: Tensor, *, log_var_range: tuple[float, float]
) -> DynamicsGradients:
    """Loss of Eq. 6, the mean over the batch, and its gradients.

    Args:
        network: layers with SiLU between them; maps ``[(G,) B, F]`` to ``[(G,) B, 2 S]``, the mean and the unbounded
            log-variance.
        x: standardised inputs, ``[(G,) B, F]``, in the dtype of the network, which is that of all products.
        target: standardised targets, ``[(G,) B, S]``. Their dtype is that of the losses and of the gradient of the
            network's output.
        log_var_range: soft bounds of the log-variance: one softplus bounds it from above, then another from below.
    """
    activations, preactivations = [x], []
    for weight, bias in zip(network.weights[:-1], network.biases[:-1]):
        preactivations.append(affine(activations[-1], weight, bias))
        activations.append(silu(preactivations[-1]))
    out = affine(activations[-1], network.weights[-1], network.biases[-1])
    loss, of_out = _output_gradient(out.to(target.dtype), target, log_var_range)
    deltas = [of_out.to(x.dtype)]
    for weight, preactivation in zip(reversed(network.weights[1:]), reversed(preactivations)):
        deltas.append(torch.ops.aten.silu_backward(input_gradient(deltas[-1], weight), preactivation))
    return DynamicsGradients(parameter_gradients(activations, deltas[::-1]), loss)


def _output_gradient(out: Tensor, target: Tensor, log_var_range: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """The loss and its gradient with respect to the mean and the unbounded log-variance."""
    mean, raw = out.chunk(2, -1)
    low, high = log_var_range
    below = high - softplus(high - raw)
    log_var = low + softplus(below - low)
    precision, error = (-log_var).exp(), mean - target
    slope = (high - raw).sigmoid() * (below - low).sigmoid()  # of log_var over raw
    of_out = torch.cat([2 * error * precision, (1 - error.square() * precision) * slope], -1) / target.shape[-2]
    return gaussian_nll(mean, log_var, target).mean(-1), of_out
