"""The matrix products of a layer, forward and backward, by the fastest library that is there.

On CPUs PyTorch hands float32 products to MKL, which takes a path of half the width on processors that are not Intel's;
oneDNN, which PyTorch carries too and uses for bfloat16, does not. At the shapes of this project (256 x 200 x 200) it
is twice as fast on an AMD EPYC 9005 (97 against 193 GFLOP/s, one thread), and it adds bias and activation on the way.
`benchmarks` measures both. Anything that is not a plain float32 or bfloat16 matrix on a CPU goes the usual way.

Nothing here is differentiable: the callers write their gradients out, or need none.

Shapes: R rows, F input features, O output features, G stacked layers.
"""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor

Activation = Literal["none", "relu", "swish"]

# The operator that PyTorch's own compiler emits for a fused linear layer; absent from builds without oneDNN.
_LINEAR: Any = getattr(torch.ops.mkldnn, "_linear_pointwise", None) if torch.backends.mkldnn.is_available() else None
_DTYPES = (torch.float32, torch.bfloat16)


def affine(x: Tensor, weight: Tensor, bias: Tensor, activation: Activation = "none") -> Tensor:
    """A layer: ``activation(x @ weight + bias)``.

    Args:
        x: ``[R, F]``, or ``[G, R, F]`` for stacked layers.
        weight: ``[F, O]`` or ``[G, F, O]``.
        bias: ``[O]`` or ``[G, O]``.
        activation: applied to each element.

    Returns:
        ``[R, O]`` or ``[G, R, O]``.
    """
    if _by_onednn(x):
        return _LINEAR(x, weight.t(), bias, activation, [], "")
    y = torch.addmm(bias, x, weight) if x.dim() == 2 else torch.baddbmm(bias.unsqueeze(-2), x, weight)
    if activation == "none":
        return y
    return y.relu_() if activation == "relu" else torch.nn.functional.silu(y, inplace=True)


def input_gradient(delta: Tensor, weight: Tensor) -> Tensor:
    """Gradient of a layer's input, ``delta @ weight.T``, for ``delta`` ``[R, O]`` or ``[G, R, O]``."""
    if _by_onednn(delta):
        return _LINEAR(delta, weight, None, "none", [], "")
    return delta @ weight.mT


def weight_gradient(x: Tensor, delta: Tensor) -> Tensor:
    """Gradient of a layer's weight, ``x.T @ delta``, for ``x`` ``[R, F]`` and ``delta`` ``[R, O]``, or stacks."""
    # A single output column is the one shape at which oneDNN's set-up costs more than the product.
    if _by_onednn(x) and delta.shape[-1] > 1:
        return _LINEAR(x.t(), delta.t(), None, "none", [], "")
    return x.mT @ delta


def _by_onednn(x: Tensor) -> bool:
    return _LINEAR is not None and x.dim() == 2 and x.dtype in _DTYPES and x.device.type == "cpu"
