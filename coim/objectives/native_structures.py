"""How ``native_gradients.cpp`` sees tensors: its structures, in which it is given their addresses.

The fields are explained in the source. Native code believes what stands in them, so every tensor is checked before.

Shapes: as `coim.objectives.native_gradients`.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from itertools import chain
from typing import Any, ClassVar

import torch
from torch import Tensor

from coim.objectives.gradients import Batch, Network

NUMBERS = {torch.float32: "float", torch.float64: "double"}


class Layer(ctypes.Structure):
    """A layer of a network and its gradients, as ``Layer`` in ``native_networks.h``."""

    _fields_ = [(name, ctypes.c_void_p) for name in ("weight", "bias", "weight_gradient", "bias_gradient")] + [
        (name, ctypes.c_int64) for name in ("inputs", "outputs")
    ]


Layers = ctypes.POINTER(Layer)


class Sac(ctypes.Structure):
    """What `coim.objectives.gradients.sac_gradients` is given, as ``Sac`` in the source."""

    _fields_: ClassVar[Any] = (
        [("team", ctypes.c_void_p), ("threads", ctypes.c_int64)]
        + [(name, ctypes.c_int64) for name in ("batch", "observed", "designed", "acted")]
        + [(name, ctypes.c_int64) for name in ("critics", "policy_layers", "critic_layers")]
        + [(name, Layers) for name in ("policy", "critic", "target")]
        + [(name, ctypes.c_void_p) for name in Batch._fields]
        + [(name, ctypes.c_double) for name in ("alpha", "gamma", "least", "most")]
        + [(name, ctypes.c_void_p) for name in ("losses", "scratch")]
    )


class Dynamics(ctypes.Structure):
    """What `coim.objectives.dynamics_gradients.dynamics_gradients` is given, as ``Dynamics`` in the source."""

    _fields_: ClassVar[Any] = (
        [("team", ctypes.c_void_p), ("threads", ctypes.c_int64)]
        + [(name, ctypes.c_int64) for name in ("batch", "layers")]
        + [(name, Layers) for name in ("layer",)]
        + [(name, ctypes.c_void_p) for name in ("x", "target")]
        + [(name, ctypes.c_double) for name in ("low", "high")]
        + [(name, ctypes.c_void_p) for name in ("loss", "scratch")]
    )


class AdamStep(ctypes.Structure):
    """Adam over flat buffers, and targets that follow the last weights; as ``Adam`` in ``native_adam.h``."""

    _fields_: ClassVar[Any] = (
        [(name, ctypes.c_void_p) for name in ("weights", "gradient", "first", "second", "targets")]
        + [(name, ctypes.c_int64) for name in ("count", "followed")]
        + [(name, ctypes.c_double) for name in ("lr", "beta1", "beta2", "eps", "decay", "tau")]
        + [("decoupled", ctypes.c_bool), ("steps", ctypes.c_double)]
    )


class Call:
    """One of the functions of the library, with its structure and the memory that it computes in."""

    def __init__(self, library: ctypes.CDLL, name: str, weights: Tensor, struct: Sac | Dynamics) -> None:
        if weights.dtype not in NUMBERS:
            raise TypeError(f"native gradients are of float32 or float64, not of {weights.dtype}; set compile=False")
        function = getattr(library, f"{name}_{NUMBERS[weights.dtype]}")
        function.restype = ctypes.c_int64
        self.struct: Any = struct
        self._function, self._at, self._like = function, ctypes.byref(struct), weights
        self._scratch = weights.new_zeros(0)

    def __call__(self) -> None:
        if not self.struct.scratch:
            self.struct.scratch = self.memory(self._function(self._at))
        self._function(self._at)

    def memory(self, numbers: int) -> int:
        """Address of memory for so many numbers, which is kept; it begins with a line of the processor's cache."""
        if len(self._scratch) < (wanted := numbers + 64 // self._like.element_size()):
            self._scratch = self._like.new_zeros(wanted)
            self.struct.scratch = None  # it lay in what is gone now
        return (self._scratch.data_ptr() + 63) // 64 * 64

    def result(self, *shape: int) -> Tensor:
        return self._like.new_empty(shape)


def layers_of(networks: Sequence[Network], gradients: Sequence[Sequence[Tensor] | None]) -> ctypes.Array[Layer]:
    """All layers of networks, one network after the other, with their gradients where there are any."""
    found = [
        Layer(
            weight=weight.data_ptr(),
            bias=bias.data_ptr(),
            weight_gradient=None if own is None else own[2 * at].data_ptr(),
            bias_gradient=None if own is None else own[2 * at + 1].data_ptr(),
            inputs=weight.shape[0],
            outputs=weight.shape[1],
        )
        for network, own in zip(networks, gradients, strict=True)
        for at, (weight, bias) in enumerate(zip(network.weights, network.biases))
    ]
    return (Layer * len(found))(*found)


def check_counts(size: int, threads: int) -> None:
    """Refuse a batch without rows, or no threads at all, by a ValueError."""
    if size < 1:
        raise ValueError("a batch has no rows; give at least one")
    if threads < 1:
        raise ValueError(f"threads is {threads}, it must be at least 1")


def check_network(name: str, network: Network, inputs: int, outputs: int, like: Tensor) -> None:
    """Refuse a network whose layers do not follow each other from inputs to outputs, by a ValueError.

    All its tensors must be as `check_tensor` wants them, and of the dtype of ``like``.
    """
    sizes = [inputs, *(weight.shape[-1] for weight in network.weights)]
    if sizes[-1] != outputs:
        raise ValueError(f"the {name} returns {sizes[-1]} numbers, and {outputs} are wanted")
    if len(network.biases) != len(network.weights):
        counts = f"{len(network.biases)} biases for {len(network.weights)} weights"
        raise ValueError(f"{counts} of the {name}; give one for each")
    if 0 in sizes:
        raise ValueError(f"the {name} has layers of {sizes} numbers, and each must have at least one")
    for weight, bias, rows, columns in zip(network.weights, network.biases, sizes, sizes[1:]):
        check_tensor(f"a weight of the {name}", weight, (rows, columns), like.dtype)
        check_tensor(f"a bias of the {name}", bias, (columns,), like.dtype)


def check_gradients(networks: Sequence[Network], gradients: Sequence[Tensor]) -> None:
    """Refuse gradients that are not one for each weight and bias, of its shape, by a ValueError."""
    wanted = [part for network in networks for part in chain(*zip(network.weights, network.biases))]
    if len(gradients) != len(wanted):
        raise ValueError(f"{len(gradients)} gradients for {len(wanted)} weights and biases; give one for each")
    for part, gradient in zip(wanted, gradients):
        check_tensor("a gradient", gradient, tuple(part.shape), part.dtype)


def check_alike(structs: Sequence[Sac | Dynamics], step: AdamStep, numbers: torch.dtype) -> None:
    """Refuse networks that do not share one size, or gradients that Adam's step does not read, by a ValueError."""
    room = range(step.gradient, step.gradient + step.count * numbers.itemsize)
    first = _sizes(structs[0])
    for struct in structs:
        if (found := _sizes(struct)) != first:
            raise ValueError(f"networks have batch, threads and layers {found} and {first}; give them the same ones")
        if not all(layer.weight_gradient in room and layer.bias_gradient in room for layer in _layers(struct)):
            raise ValueError("a gradient lies outside of the flat buffer that the step of Adam reads; cut it from that")


def _layers(struct: Sac | Dynamics) -> list[Layer]:
    """All layers that learn."""
    if isinstance(struct, Dynamics):
        return struct.layer[: struct.layers]
    return struct.policy[: struct.policy_layers] + struct.critic[: struct.critics * struct.critic_layers]


def _sizes(struct: Sac | Dynamics) -> tuple[Any, ...]:
    return struct.batch, struct.threads, [(layer.inputs, layer.outputs) for layer in _layers(struct)]


def check_tensor(name: str, tensor: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    """Refuse a tensor that native code would read as another one.

    Raises:
        ValueError: if its shape or dtype differ, or it is not contiguous on the CPU.
    """
    if tuple(tensor.shape) != shape or tensor.dtype != dtype:
        raise ValueError(f"{name} is {tuple(tensor.shape)} of {tensor.dtype}, and {shape} of {dtype} is wanted")
    if tensor.device.type != "cpu" or not tensor.is_contiguous():
        raise ValueError(f"{name} must be contiguous and on the CPU; call .contiguous().cpu() before")
