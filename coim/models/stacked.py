"""Many equal multi-layer perceptrons as one batched module.

The critics of one agent, the members of one ensemble and the runs of one fleet are copies of one small network.  Their
weights are stacked along leading dimensions, so that one batched matrix product computes a layer of all copies.
Without gradients, a CPU is faster with one product after the other, by :mod:`coim.products`.

Shapes: ``B`` batch, ``K`` runs, ``N`` copies, ``G = K * N`` (1 where neither axis exists), ``R`` rows, ``F`` input
features, ``O`` output features.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from itertools import pairwise
from numbers import Integral
from typing import TypeVar, cast

import torch
from torch import Tensor, nn

from coim.calling import called_as
from coim.products import Activation, affine, emulated

ModuleT = TypeVar("ModuleT", bound=nn.Module)

# Rows for products without gradients: with fewer, the set-up of each product costs more than it saves; with more, the
# activations do not fit the cache of a CPU core.
FEW_ROWS, CHUNK_ROWS = 128, 2_000
FUSED: dict[type[nn.Module], Activation] = {nn.ReLU: "relu", nn.SiLU: "swish"}


class StackedLinear(nn.Module):
    """An affine layer for each copy: ``x @ weight + bias``.

    Args:
        in_features: ``F``.
        out_features: ``O``.
        stack: leading dimensions of the weights, ``()`` for a single layer.
        device: where the weights live.
        dtype: of the weights.

    Attributes:
        weight: ``[*stack, F, O]``, the transpose of :class:`torch.nn.Linear`'s.
        bias: ``[*stack, O]``.

    Example:
        >>> StackedLinear(4, 2, stack=(3,))(torch.zeros(3, 10, 4)).shape
        torch.Size([3, 10, 2])
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        stack: tuple[int, ...] = (),
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(*stack, in_features, out_features, device=device, dtype=dtype))
        self.bias = nn.Parameter(torch.empty(*stack, out_features, device=device, dtype=dtype))
        self.reset_parameters()

    def reset_parameters(self, generator: torch.Generator | None = None) -> None:
        """Draw new weights for each copy, as :class:`torch.nn.Linear` does: U(-1/sqrt(F), 1/sqrt(F))."""
        bound = 1 / math.sqrt(self.weight.shape[-2])
        nn.init.uniform_(self.weight, -bound, bound, generator=generator)
        nn.init.uniform_(self.bias, -bound, bound, generator=generator)

    def forward(self, x: Tensor) -> Tensor:
        """Apply the layer: ``[R, F] -> [R, O]`` without a stack, ``[G, R, F] -> [G, R, O]`` with one."""
        if emulated(x):
            return self._product(x.float(), self.weight.float(), self.bias.float()).to(x.dtype)
        return self._product(x, self.weight, self.bias)

    @staticmethod
    def _product(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        if weight.dim() == 2:
            return torch.addmm(bias, x, weight)
        return torch.baddbmm(bias.flatten(0, -2).unsqueeze(1), x, weight.flatten(0, -3))


class StackedMLP(nn.Module):
    """Equal MLPs, one for each run and copy, evaluated together.

    Args:
        in_features: sum of the sizes of all inputs, ``F``.
        out_features: ``O``.
        num_cells: units of each hidden layer.
        num_runs: ``K``, independent runs.  Each run has its own input rows.  None: no run axis.
        num_copies: ``N``, copies that see the same input.  None: no copy axis.
        activation: class of the nonlinearity after each hidden layer; made with ``inplace=True``, which saves an eighth
            of the time on a CPU.
        device: where the weights live.
        dtype: of the weights.

    Attributes:
        layers: the :class:`StackedLinear` layers in order, hidden ones first.

    Raises:
        ValueError: if a size is no whole number, or below one.

    Example:
        >>> critics = StackedMLP(5, 1, [200, 200, 200], num_copies=2)
        >>> critics(torch.zeros(256, 3), torch.zeros(256, 2)).shape
        torch.Size([256, 2, 1])
        >>> fleet = StackedMLP(5, 1, [8], num_runs=4, num_copies=2)
        >>> fleet(torch.zeros(256, 4, 5)).shape
        torch.Size([256, 4, 2, 1])
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        num_cells: Sequence[int],
        *,
        num_runs: int | None = None,
        num_copies: int | None = None,
        activation: Callable[..., nn.Module] = nn.ReLU,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        sizes = [in_features, *num_cells, out_features]
        self.stack = tuple(n for n in (num_runs, num_copies) if n is not None)
        if not all(isinstance(size, Integral) and size >= 1 for size in (*sizes, *self.stack)):
            raise ValueError(f"layer sizes {sizes} and stack {self.stack} must all be whole numbers of at least 1")
        self.in_features, self.out_features = in_features, out_features
        self.num_runs, self.num_copies = num_runs, num_copies
        self.activation = activation(inplace=True)
        self.layers = nn.ModuleList(
            StackedLinear(fan_in, fan_out, stack=self.stack, device=device, dtype=dtype)
            for fan_in, fan_out in pairwise(sizes)
        )

    def reset_parameters(self, generator: torch.Generator | None = None) -> None:
        """Draw new weights, independent for each copy.

        Args:
            generator: source of the draws, torch's global one if None.
        """
        for layer in self.layers:
            layer.reset_parameters(generator)  # type: ignore[operator]

    def forward(self, *inputs: Tensor) -> Tensor:
        """Evaluate every copy on the inputs.

        Args:
            inputs: tensors that are concatenated on their last dimension to ``[*B, (K,) F]``.

        Returns:
            ``[*B, (K,) (N,) O]``.

        Raises:
            ValueError: if the inputs do not have ``F`` features, or their last batch dimension is not the run axis.
        """
        x = inputs[0] if len(inputs) == 1 else torch.cat(inputs, -1)
        self._check(x, inputs)
        batch, runs, copies = x.shape[:-1], self.num_runs or 1, self.num_copies or 1
        if self.serves_bare(x, batch.numel() // runs):
            out = self._one_by_one(x.reshape(-1, runs, self.in_features))
            return out.reshape(*batch, *(() if self.num_copies is None else (copies,)), self.out_features)
        if not self.stack:
            return self._product(x.reshape(-1, self.in_features)).reshape(*batch, self.out_features)
        x = x.reshape(-1, runs, 1, self.in_features).permute(1, 2, 0, 3)  # [K, 1, R, F]
        x = x.expand(-1, copies, -1, -1).reshape(runs * copies, -1, self.in_features)
        out = self._product(x).unflatten(0, (runs, copies)).permute(2, 0, 1, 3)  # [R, K, N, O]
        return out.reshape(*batch, *(() if self.num_copies is None else (copies,)), self.out_features)

    def forward_stacked(self, x: Tensor) -> Tensor:
        """Evaluate each copy on rows of its own.

        Args:
            x: ``[G, R, F]``, with the copies of one run next to each other.

        Returns:
            ``[G, R, O]``.
        """
        return self._product(x) if self.stack else self._product(x.squeeze(0)).unsqueeze(0)

    def forward_copy(self, copy: int, x: Tensor) -> Tensor:
        """Evaluate one copy without gradients, if :meth:`serves_bare` allows it.

        Args:
            copy: in ``0 .. G - 1``, with the copies of one run next to each other.
            x: ``[R, F]``.

        Returns:
            ``[R, O]``, equal to `forward_stacked` up to rounding.
        """
        layers = [
            (layer.weight.flatten(0, -3)[copy], layer.bias.flatten(0, -2)[copy])
            if self.stack
            else (layer.weight, layer.bias)
            for layer in cast(Iterable[StackedLinear], self.layers)
        ]
        hidden = FUSED[type(self.activation)]
        parts = []
        for rows in x.split(CHUNK_ROWS):
            for weight, bias in layers[:-1]:
                rows = affine(rows, weight, bias, hidden)
            parts.append(affine(rows, *layers[-1]))
        return parts[0] if len(parts) == 1 else torch.cat(parts)

    def serves_bare(self, x: Tensor, num_rows: int) -> bool:
        """Return whether :meth:`forward_copy` is the faster path for ``num_rows`` rows per copy, and allowed.

        It is for many rows on a CPU, outside of autograd, autocast, function transforms and compilers, as long as
        layers and activation have no hooks and no `forward` of their own.
        """
        return (
            num_rows >= FEW_ROWS
            and not torch.is_grad_enabled()
            and type(self.activation) in FUSED
            and x.device.type == "cpu"
            and x.dtype == self.layers[0].weight.dtype
            and x.dtype in (torch.float32, torch.bfloat16)
            and not torch.is_autocast_enabled("cpu")  # which chooses the precision of products itself
            and not torch.compiler.is_compiling()
            and torch._C._functorch.peek_interpreter_stack() is None
            and called_as(self.activation, type(self.activation))
            and all(called_as(layer, StackedLinear) for layer in self.layers)
        )

    def keep_run(self, run: int) -> None:
        """Keep one run only, in place; see :func:`select_run`."""
        for layer in self.layers:
            for name, weights in list(layer.named_parameters()):
                setattr(layer, name, nn.Parameter(weights.detach()[run].clone(), weights.requires_grad))
        self.stack, self.num_runs = self.stack[1:], None

    def _product(self, x: Tensor) -> Tensor:
        last = len(self.layers) - 1
        for i, layer in enumerate(self.layers):
            x = layer(x) if i == last else self.activation(layer(x))
        return x

    def _one_by_one(self, x: Tensor) -> Tensor:
        """Evaluate the copies one after the other: ``[R, K, F] -> [R, K, N, O]``."""
        runs, copies = x.shape[1], self.num_copies or 1
        if runs == copies == 1:
            return self.forward_copy(0, x.squeeze(1))
        out = x.new_empty(len(x), runs, copies, self.out_features)
        for run in range(runs):
            rows = x[:, run].contiguous()
            for n in range(copies):
                out[:, run, n] = self.forward_copy(run * copies + n, rows)
        return out

    def _check(self, x: Tensor, inputs: tuple[Tensor, ...]) -> None:
        if x.shape[-1] != self.in_features:
            sizes = [i.shape[-1] for i in inputs]
            raise ValueError(f"inputs of sizes {sizes} have {x.shape[-1]} features, this network {self.in_features}")
        if self.num_runs is not None and (x.dim() < 2 or x.shape[-2] != self.num_runs):
            raise ValueError(
                f"input of shape {list(x.shape)} needs the {self.num_runs} runs of this network as its last batch "
                "dimension; cut one run out with select_run() for rows of a single run"
            )


def select_run(module: ModuleT, run: int) -> ModuleT:
    """Copy one run out of a fleet.

    Args:
        module: any module built with ``num_runs``: policy, critics, ensemble.
        run: index of the run, in ``0 .. K - 1``.

    Returns:
        A deep copy without a run axis, which shares nothing with ``module``.

    Raises:
        ValueError: if nothing in ``module`` has a run axis.
        IndexError: if there is no such run.

    Example:
        >>> fleet = StackedMLP(5, 1, [8], num_runs=4, num_copies=2)
        >>> select_run(fleet, 3)(torch.zeros(256, 5)).shape
        torch.Size([256, 2, 1])
    """
    copy = deepcopy(module)
    fleet = [part for part in copy.modules() if hasattr(part, "keep_run") and part.num_runs is not None]
    if not fleet:
        raise ValueError(f"{type(module).__name__} has no run axis; build it with num_runs to stack runs")
    for part in fleet:
        if not 0 <= run < part.num_runs:  # type: ignore[operator]
            raise IndexError(f"run {run} is outside 0 .. {part.num_runs - 1}")  # type: ignore[operator]
        part.keep_run(run)  # type: ignore[operator]
    return copy
