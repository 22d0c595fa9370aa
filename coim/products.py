"""The matrix products of a layer, forward and backward, by the fastest library that is there.

On CPUs PyTorch hands float32 products to MKL, which takes a path of half the width on processors that are not Intel's;
oneDNN, which PyTorch carries too and uses for bfloat16, does not. At the shapes of this project (256 x 200 x 200) it
is twice as fast on an AMD EPYC 9005 (97 against 193 GFLOP/s, one thread), and it adds bias and activation on the way.
`benchmarks` measures both. Anything that is not a plain float32 or bfloat16 matrix on a CPU goes the usual way.

Nothing here is differentiable: the callers write their gradients out, or need none. A compiler sees oneDNN's call as
one operator of this library's, `coim::linear`: Inductor takes PyTorch's own only with weights that never change.

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

_LIBRARY = torch.library.Library("coim", "FRAGMENT")
_LIBRARY.define("linear(Tensor x, Tensor weight, Tensor? bias, str activation) -> Tensor")


@torch.library.impl(_LIBRARY, "linear", "CPU")
def _linear(x: Tensor, weight: Tensor, bias: Tensor | None, activation: str) -> Tensor:
    """``activation(x @ weight.T + bias)`` by oneDNN, as PyTorch's operator takes it: weight ``[O, F]``."""
    return _LINEAR(x, weight, bias, activation, [], "")


@torch.library.register_fake("coim::linear", lib=_LIBRARY)
def _linear_shape(x: Tensor, weight: Tensor, bias: Tensor | None, activation: str) -> Tensor:
    return x.new_empty(x.shape[0], weight.shape[0])


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
    if _by_onednn(x, weight):
        return _onednn(x, weight.t(), bias, activation)
    y = torch.addmm(bias, x, weight) if x.dim() == 2 else torch.baddbmm(bias.unsqueeze(-2), x, weight)
    if activation == "none":
        return y
    return y.relu_() if activation == "relu" else torch.nn.functional.silu(y, inplace=True)


def input_gradient(delta: Tensor, weight: Tensor) -> Tensor:
    """Gradient of a layer's input, ``delta @ weight.T``, for ``delta`` ``[R, O]`` or ``[G, R, O]``."""
    if _by_onednn(delta, weight):
        return _onednn(delta, weight)
    # The outer product of a single output column is no work for a library of matrix products.
    return delta * weight.mT if delta.shape[-1] == 1 else delta @ weight.mT


def weight_gradient(x: Tensor, delta: Tensor) -> Tensor:
    """Gradient of a layer's weight, ``x.T @ delta``, for ``x`` ``[R, F]`` and ``delta`` ``[R, O]``, or stacks."""
    if _by_onednn(x, delta):
        return _onednn(x.t(), delta.t())
    return x.mT @ delta


def _by_onednn(x: Tensor, other: Tensor) -> bool:
    """Whether its set-up pays: at a single output column it costs more than the product."""
    plain = x.dim() == 2 and x.dtype in _DTYPES and x.device.type == "cpu"
    return _LINEAR is not None and plain and other.shape[-1] > 1


def _onednn(x: Tensor, weight: Tensor, bias: Tensor | None = None, activation: Activation = "none") -> Tensor:
    """As `_linear`, to a compiler as one operator, otherwise without the few microseconds that this costs."""
    if torch.compiler.is_compiling():
        return torch.ops.coim.linear(x, weight, bias, activation)
    return _LINEAR(x, weight, bias, activation, [], "")
