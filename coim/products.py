"""The matrix products of a layer, forward and backward, by the library that is fastest on this kind of processor.

PyTorch has two libraries for products on a CPU, its own way (MKL in its x86 builds) and oneDNN, and which is faster
depends on the processor: `FASTEST` says what was measured. The choice follows from what the processor can do and never
from a clock, so that the same seed on the same machine gives the same bits on every start. `use` takes another one.
Anything that is not a float32 or bfloat16 matrix on a CPU goes PyTorch's own way.

bfloat16 on a processor that has no products for it is emulated: a float32 product of the rounded inputs, whose result
is rounded once. PyTorch's own takes ten times as long there,
and oneDNN refuses it.

Nothing here is differentiable: the callers write their gradients out, or need none.

Shapes: R rows, F input features, O output features, G stacked layers.
"""

from __future__ import annotations

import platform
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor

Activation = Literal["none", "relu", "swish"]
Library = Literal["torch", "onednn", "emulated"]
Named = Literal["auto", "onednn", "torch"]
Kind = Literal["AVX-512 of Intel", "AVX-512", "AVX2", "other"]


class Choice(NamedTuple):
    """Which library multiplies matrices of a dtype on the CPU; ``"emulated"`` is for bfloat16 alone."""

    float32: Library
    bfloat16: Library


# Measured on one thread at the shapes of the recipes (batch 256, layers of 200); `make bench` says where it is wrong.
# "update" is an update of policy and critics with these products, compiled by Inductor, in multiples of torch.mm's time
# for the float32 products. `python -m benchmarks --only libraries` measures it without a compiler.
FASTEST: dict[Kind, Choice] = {
    # Xeon with AMX. float32: update 1.51, by oneDNN 1.91. bfloat16: 0.99, by oneDNN 1.08.
    "AVX-512 of Intel": Choice("torch", "torch"),
    # AMD EPYC 9005: 193 GFLOP/s by oneDNN, 97 by MKL, which takes half the width on processors that are not Intel's.
    "AVX-512": Choice("onednn", "onednn"),
    # AMD EPYC 7003: 36 GFLOP/s by MKL, 22 by oneDNN; a Xeon limited to AVX2: update 1.36, by oneDNN 1.57.
    "AVX2": Choice("torch", "emulated"),
    # Not measured: ARM, macOS.
    "other": Choice("torch", "torch"),
}

# The operator that PyTorch's own compiler emits for a fused linear layer; absent from builds without oneDNN.
_LINEAR: Any = getattr(torch.ops.mkldnn, "_linear_pointwise", None) if torch.backends.mkldnn.is_available() else None


def use(products: Named | Choice) -> Choice:
    """Choose the library of all products on the CPU, in this process and from now on.

    Args:
        products: ``"auto"`` for `fastest`; a library by name, where bfloat16 is emulated if the processor has no
            products for it; or a choice, taken as it is.

    Returns:
        The choice.

    Raises:
        ValueError: if there is no such library, or this build of torch or this processor cannot take it.
    """
    global _chosen
    if isinstance(products, Choice):
        choice = products
    elif products == "auto":
        choice = fastest()
    else:
        choice = Choice(products, products if has_bfloat16() else "emulated")
    _check(choice)
    _chosen = choice
    return choice


def chosen() -> Choice:
    """The choice in force: the `fastest` until `use` is called."""
    return _chosen


def fastest() -> Choice:
    """What `FASTEST` has for this processor, as far as this build of torch can take it."""
    choice = FASTEST[kind_of_processor()]
    if "onednn" in choice and _LINEAR is None:
        choice = Choice("torch", "torch")
    return choice if has_bfloat16() else choice._replace(bfloat16="emulated")


def kind_of_processor() -> Kind:
    """The row of `FASTEST` for this processor, by the instructions that torch takes and by its maker."""
    instructions = torch.backends.cpu.get_cpu_capability()
    if instructions == "AVX512":
        return "AVX-512 of Intel" if "GenuineIntel" in _maker() else "AVX-512"
    return "AVX2" if instructions == "AVX2" else "other"


def has_bfloat16() -> bool:
    """Whether the processor has products of bfloat16 and torch takes them."""
    supported = getattr(torch.ops.mkldnn, "_is_mkldnn_bf16_supported", None)
    if supported is None or not supported():
        return False
    # oneDNN also says yes to AVX-512 without bfloat16, where it converts inside the product: 31 GFLOP/s, emulated 102.
    return torch.backends.cpu.get_cpu_capability() != "AVX512" or torch.cpu._is_avx512_bf16_supported()


def emulated(x: Tensor) -> bool:
    """Whether products of this matrix are taken in float32 and rounded."""
    return _library_of(x) == "emulated"


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
    if emulated(x):
        return affine(x.float(), weight.float(), bias.float(), activation).to(x.dtype)
    if _by_onednn(x, weight):
        # Its own ReLU turns NaN into 0, so that networks that have diverged would look sound.
        y = _onednn(x, weight.t(), bias, "none" if activation == "relu" else activation)
        return y.relu_() if activation == "relu" else y
    y = torch.addmm(bias, x, weight) if x.dim() == 2 else torch.baddbmm(bias.unsqueeze(-2), x, weight)
    if activation == "none":
        return y
    return y.relu_() if activation == "relu" else torch.nn.functional.silu(y, inplace=True)


def input_gradient(delta: Tensor, weight: Tensor) -> Tensor:
    """Gradient of a layer's input, ``delta @ weight.T``, for ``delta`` ``[R, O]`` or ``[G, R, O]``."""
    if emulated(delta):
        return input_gradient(delta.float(), weight.float()).to(delta.dtype)
    if _by_onednn(delta, weight):
        return _onednn(delta, weight)
    # The outer product of a single output column is no work for a library of matrix products.
    return delta * weight.mT if delta.shape[-1] == 1 else delta @ weight.mT


def weight_gradient(x: Tensor, delta: Tensor) -> Tensor:
    """Gradient of a layer's weight, ``x.T @ delta``, for ``x`` ``[R, F]`` and ``delta`` ``[R, O]``, or stacks."""
    if emulated(x):
        return weight_gradient(x.float(), delta.float()).to(x.dtype)
    if _by_onednn(x, delta):
        return _onednn(x.t(), delta.t())
    return x.mT @ delta


def _library_of(x: Tensor) -> Library:
    if x.device.type != "cpu" or x.dtype not in (torch.float32, torch.bfloat16):
        return "torch"
    return chosen().float32 if x.dtype == torch.float32 else chosen().bfloat16


def _by_onednn(x: Tensor, other: Tensor) -> bool:
    """Whether oneDNN is chosen and its set-up pays: at a single output column it costs more than the product."""
    return x.dim() == 2 and other.shape[-1] > 1 and _library_of(x) == "onednn"


def _onednn(x: Tensor, weight: Tensor, bias: Tensor | None = None, activation: Activation = "none") -> Tensor:
    """``activation(x @ weight.T + bias)``, as PyTorch's operator takes it: weight ``[O, F]``."""
    # It reads a bias as if it were contiguous, whatever its strides.
    return _LINEAR(x, weight, None if bias is None else bias.contiguous(), activation, [], "")


def _check(choice: Choice) -> None:
    """Refuse what cannot be computed here."""
    if choice.float32 not in ("torch", "onednn") or choice.bfloat16 not in get_args(Library):
        raise ValueError(f"products by {choice} are unknown; choose 'auto', 'onednn' or 'torch'")
    if "onednn" in choice and _LINEAR is None:
        raise ValueError("this build of torch has no oneDNN; choose products 'torch' or 'auto'")
    if choice.bfloat16 != "emulated" and not has_bfloat16():
        raise ValueError("this processor has no products of bfloat16; choose products 'auto', which emulates them")


def _maker() -> str:
    """The processor's maker where the system tells, as ``GenuineIntel`` or ``AuthenticAMD``, in a longer text."""
    try:
        with Path("/proc/cpuinfo").open() as lines:
            return next((line for line in lines if line.startswith("vendor_id")), "")
    except OSError:
        return platform.processor()


_chosen = fastest()
