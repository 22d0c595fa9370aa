"""The floor of a computation: its matrix products and nothing else.

Each function lists the products that the equations need, given that nothing is computed in vain: no gradient of the
critics' weights from the actor's loss, no gradient of an input that nobody reads. `alone` takes them, and only them.

Shapes: R rows, F input features, O output features.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor

from benchmarks.measure import taking
from coim.products import Choice, affine, chosen, input_gradient, weight_gradient

Kind = Literal["forward", "input", "weight"]


@dataclass(frozen=True)
class Product:
    """One matrix product of a layer.

    Attributes:
        kind: the layer itself ``[R, F] x [F, O]``, its input's gradient ``[R, O] x [O, F]``, or its weight's
            ``[F, R] x [R, O]``.
        network: whose layer it is; products of one layer read the same weights.
        layer: 0 for the first.
        rows: R.
        inputs: F.
        outputs: O.
    """

    kind: Kind
    network: str
    layer: int
    rows: int
    inputs: int
    outputs: int

    @property
    def flop(self) -> int:
        """Multiplications and additions, each counted."""
        return 2 * self.rows * self.inputs * self.outputs


def forward(network: str, rows: int, sizes: Sequence[int]) -> list[Product]:
    """Evaluate a network of layers ``sizes[0] -> sizes[1] -> ...``."""
    return [Product("forward", network, i, rows, f, o) for i, (f, o) in enumerate(pairwise(sizes))]


def weight_gradients(network: str, rows: int, sizes: Sequence[int]) -> list[Product]:
    """Gradients of all weights, given those of the pre-activations."""
    return [Product("weight", network, i, rows, f, o) for i, (f, o) in enumerate(pairwise(sizes))]


def input_gradients(network: str, rows: int, sizes: Sequence[int]) -> list[Product]:
    """Gradients of all hidden activations, last first."""
    layers = list(enumerate(pairwise(sizes)))
    return [Product("input", network, i, rows, f, o) for i, (f, o) in reversed(layers[1:])]


def sac_products(
    *, batch: int, observations: int, designs: int, actions: int, cells: Sequence[int], critics: int = 2
) -> list[Product]:
    """One update by Eq. 3-4 or 7-8, as `coim.objectives.gradients` does it: 0.69 GFLOP at Half-Cheetah's sizes."""
    policy = [observations + designs, *cells, 2 * actions]
    critic = [observations + actions + designs, *cells, 1]
    found = forward("policy", 2 * batch, policy)  # at s and s'
    for n in range(critics):
        found += forward(f"target {n}", batch, critic)
    for n in range(critics):
        name = f"critic {n}"
        found += forward(name, 2 * batch, critic)  # at the stored action and the policy's
        found += input_gradients(name, 2 * batch, critic)
        found += weight_gradients(name, batch, critic)  # of the stored action's error alone
        found.append(Product("input", f"{name} of the action", 0, batch, actions, cells[0]))
    return found + input_gradients("policy", batch, policy) + weight_gradients("policy", batch, policy)


def ensemble_products(
    *, batch: int, observations: int, designs: int, actions: int, cells: Sequence[int], members: int = 3
) -> list[Product]:
    """One update by Eq. 6: 2.4 GFLOP at Half-Cheetah's sizes."""
    sizes = [observations + actions + designs, *cells, 2 * observations]
    found = []
    for e in range(members):
        found += forward(f"member {e}", batch, sizes)
        found += input_gradients(f"member {e}", batch, sizes)
        found += weight_gradients(f"member {e}", batch, sizes)
    return found


def imagination_products(
    *,
    chunks: Iterable[int],
    observations: int,
    designs: int,
    actions: int,
    cells: Sequence[int],
    model_cells: Sequence[int],
    members: int = 3,
) -> list[Product]:
    """An action and one member's prediction for each row, in chunks of so many rows."""
    policy = [observations + designs, *cells, 2 * actions]
    model = [observations + actions + designs, *model_cells, 2 * observations]
    found = []
    for rows in chunks:
        found += forward("policy", rows, policy)
        for e in range(members):
            found += forward(f"member {e}", rows // members + (e < rows % members), model)
    return found


def design_value_products(
    *, chunks: Iterable[int], observations: int, designs: int, actions: int, cells: Sequence[int], critics: int = 2
) -> list[Product]:
    """Policy and critics at every start state of every design, in chunks of so many rows."""
    policy = [observations + designs, *cells, 2 * actions]
    critic = [observations + actions + designs, *cells, 1]
    found = []
    for rows in chunks:
        found += forward("policy", rows, policy)
        for n in range(critics):
            found += forward(f"critic {n}", rows, critic)
    return found


def flop(products: Iterable[Product]) -> int:
    """Multiplications and additions of all of them."""
    return sum(product.flop for product in products)


def alone(
    products: Sequence[Product],
    *,
    times: int = 1,
    by: Choice | None = None,
    dtype: torch.dtype = torch.float32,
) -> Callable[[], None]:
    """An action that takes the products, so many times over, and nothing else.

    Weights are each layer's own. Inputs and results of one shape share their memory, so that they stay in the cache as
    the activations of a real network do.

    Args:
        products: in the order in which they are taken.
        times: how often.
        by: libraries that `coim.products` lets multiply, as in a learner; None takes torch.mm, into memory that is
            there already.
        dtype: of all of them.
    """
    operands = _Operands(dtype)
    calls = [(operands.bare if by is None else operands.of_a_layer)(product) for product in products]

    @torch.no_grad()
    def run() -> None:
        with taking(by or chosen()):
            for _ in range(times):
                for call in calls:
                    call()

    return run


class _Operands:
    """Matrices by what they are."""

    def __init__(self, dtype: torch.dtype) -> None:
        self._dtype = dtype
        self._made: dict[tuple, Tensor] = {}
        self._generator = torch.Generator().manual_seed(0)

    def bare(self, product: Product) -> Callable[[], object]:
        x, weight, delta = self._of(product)
        kind, rows, inputs, outputs = product.kind, product.rows, product.inputs, product.outputs
        if kind == "forward":
            return partial(torch.mm, x, weight, out=self._matrix("result", rows, outputs))
        if kind == "input":
            return partial(torch.mm, delta, weight.t(), out=self._matrix("result", rows, inputs))
        gradient = self._matrix(f"gradient {product.network} {product.layer}", inputs, outputs)
        return partial(torch.mm, x.t(), delta, out=gradient)

    def of_a_layer(self, product: Product) -> Callable[[], object]:
        x, weight, delta = self._of(product)
        if product.kind == "forward":
            return partial(affine, x, weight, torch.zeros(product.outputs, dtype=self._dtype))
        if product.kind == "input":
            return partial(input_gradient, delta, weight)
        return partial(weight_gradient, x, delta)

    def _of(self, product: Product) -> tuple[Tensor, Tensor, Tensor]:
        """Input ``[R, F]``, weight ``[F, O]`` and gradient of the output ``[R, O]``."""
        return (
            self._matrix("input", product.rows, product.inputs),
            self._matrix(f"{product.network} {product.layer}", product.inputs, product.outputs),
            self._matrix("input", product.rows, product.outputs),
        )

    def _matrix(self, name: str, *shape: int) -> Tensor:
        if (name, *shape) not in self._made:
            matrix = torch.randn(*shape, generator=self._generator) / shape[0] ** 0.5
            self._made[(name, *shape)] = matrix.to(self._dtype)
        return self._made[(name, *shape)]
