"""Gradients and updates on a CPU by native code, ``native_gradients.cpp``: the written-out ones up to rounding.

`coim.objectives.gradients` and `coim.objectives.dynamics_gradients` say what is computed;
``tests/objectives/test_native_gradients.py`` holds the two equal. There every operation goes over the whole batch and
writes its result to memory. Here a block of rows goes through all networks and back while it is in the cache, and ReLU
and what is multiplied on the way back happen in the registers of a product. The result has the same bits with any
number of threads.

Shapes: U updates, K runs, M members of all runs, B batch, N critics, S observation, D design, A action, F inputs.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from coim.native import Source, team
from coim.objectives.gradients import Batch, Network
from coim.objectives.native_structures import (
    NUMBERS,
    AdamStep,
    Call,
    Dynamics,
    Sac,
    check_alike,
    check_counts,
    check_gradients,
    check_network,
    check_tensor,
    layers_of,
)
from coim.products import Kind, kind_of_processor

SOURCE = Source(
    path=Path(__file__).with_suffix(".cpp"),
    headers=(Path(__file__).with_name("native_networks.h"), Path(__file__).with_name("native_adam.h")),
    # -O3 makes nothing faster here, and takes a third longer. Adam needs its loop in vectors, and bare square roots.
    options=("-O2", "-fno-math-errno", "-ffp-contract=fast"),
    wished=("-ftree-loop-vectorize", "-fvect-cost-model=dynamic"),
    purpose="native gradients",
    way_out="set compile=False",
)
# AMD EPYC with AVX2, one thread, in multiples of torch.mm's time for the products, native and written out: SAC 3 x 64
# 0.94 and 2.5, 3 x 200 1.03 and 1.5; a member of an ensemble 3 x 128 1.10 and 1.8, 3 x 256 1.08 and 1.4. Whole updates
# of three members of 3 x 500 1.19 and 1.29, on two threads 1.11 and 1.37. All in float32. Wider layers were not
# measured, nor these on processors with AVX-512.
UP_TO = 256
UP_TO_IN_ENSEMBLES: dict[Kind, int] = {"AVX2": 512}


@functools.cache
def library() -> ctypes.CDLL:
    """The compiled source.

    Raises:
        RuntimeError: if it cannot be compiled, see `coim.native.Source.library`.
    """
    return SOURCE.library()


def pays(weights: Sequence[Tensor], *, of_ensemble: bool = False) -> bool:
    """Whether there is native code for networks with such weights and biases, ``[*, O]``, known to be faster."""
    most = UP_TO_IN_ENSEMBLES.get(kind_of_processor(), UP_TO) if of_ensemble else UP_TO
    return all(part.dtype in NUMBERS and part.shape[-1] <= most for part in weights)


class NativeSAC:
    """`coim.objectives.gradients.sac_gradients` of a policy and its critics, written where an optimiser reads them.

    It holds the addresses of all tensors that it is made with: they must stay where they are.

    Args:
        policy: contiguous tensors on the CPU, all of one dtype, as are those of the next four.
        critics: N networks.
        targets: the N target critics.
        gradients: of the policy and of each critic (weight, bias, weight, bias, ...), to be written over.
        batch: rows of the shapes that all others will have.
        log_scale_range: bounds to which the log-scale is clamped.
        threads: on which to compute.

    Raises:
        TypeError: if the networks are neither float32 nor float64.
        ValueError: if a tensor has another shape or dtype, or is not contiguous on the CPU; if rows, numbers in a layer
            or threads are fewer than one.
        RuntimeError: if the code cannot be compiled.
    """

    def __init__(
        self,
        policy: Network,
        critics: Sequence[Network],
        targets: Sequence[Network],
        gradients: Sequence[Tensor],
        batch: Batch,
        *,
        log_scale_range: tuple[float, float],
        threads: int = 1,
    ) -> None:
        weights = policy.weights[0]
        size, observed = batch.observation.shape
        designed, acted = batch.design.shape[-1], batch.action.shape[-1]
        check_network("policy", policy, observed + designed, 2 * acted, weights)
        for critic in (*critics, *targets):
            check_network("critic", critic, observed + acted + designed, 1, weights)
        if len(targets) != len(critics):
            raise ValueError(f"{len(targets)} targets for {len(critics)} critics; give one for each")
        first = [tuple(weight.shape) for weight in critics[0].weights]
        for other in (*critics, *targets):
            if (found := [tuple(weight.shape) for weight in other.weights]) != first:
                raise ValueError(f"a critic has layers {found}, the first one {first}; give them the same ones")
        check_counts(size, threads)
        check_gradients([policy, *critics], gradients)
        self._shapes = {
            "observation": (size, observed),
            "design": (size, designed),
            "action": (size, acted),
            "next_observation": (size, observed),
            "reward": (size,),
            "terminated": (size,),
            "noise": (size, acted),
            "next_noise": (size, acted),
            "weight": (size,),
        }
        self._dtype = weights.dtype
        self.check(batch)
        split = [len(policy.weights) * 2, *(len(critic.weights) * 2 for critic in critics)]
        own, *of_critics = (list(part) for part in _split(gradients, split))
        self.call = Call(
            library(),
            "sac",
            weights,
            Sac(
                team=team() if threads > 1 else None,
                threads=threads,
                batch=size,
                observed=observed,
                designed=designed,
                acted=acted,
                critics=len(critics),
                policy_layers=len(policy.weights),
                critic_layers=len(critics[0].weights),
                policy=layers_of([policy], [own]),
                critic=layers_of(critics, of_critics),
                target=layers_of(targets, [None] * len(targets)),
                least=log_scale_range[0],
                most=log_scale_range[1],
            ),
        )

    def __call__(self, batch: Batch, *, alpha: float, gamma: float) -> Tensor:
        """Write the gradients; return the losses of actor and critics, and the entropy, ``[3]``.

        Args:
            batch: contiguous rows of the shapes and dtypes of the first ones.
            alpha: entropy temperature.
            gamma: discount.
        """
        struct = self.call.struct
        for name, rows in zip(self._shapes, batch):
            setattr(struct, name, rows.data_ptr())
        struct.alpha, struct.gamma = alpha, gamma
        losses = self.call.result(3)
        struct.losses = losses.data_ptr()
        self.call()
        return losses

    def check(self, batch: Batch, *lead: int) -> None:
        """Refuse rows of other shapes or dtypes than the first ones, with these dimensions before them."""
        for (name, shape), rows in zip(self._shapes.items(), batch):
            check_tensor(name, rows, (*lead, *shape), torch.bool if name == "terminated" else self._dtype)


def sac_updates(runs: Sequence[NativeSAC], rows: Batch, step: AdamStep, *, alpha: float, gamma: float) -> Tensor:
    """Compute gradients of all runs, do one step of Adam and move the targets, for one batch after the other.

    With several threads each takes runs of its own, as far as there are enough of them.

    Args:
        runs: K of them, of the same sizes, with gradients in one flat buffer that ``step`` reads.
        rows: contiguous, ``[U, K, B, ...]``, of the dtypes of those that the runs were made with.
        step: its count of steps is not changed.
        alpha: entropy temperature.
        gamma: discount.

    Returns:
        Losses of actor and critics, and the entropy, ``[U, K, 3]``.

    Raises:
        ValueError: if rows have another shape or dtype, or are not contiguous; if the runs differ in their sizes, or a
            gradient is not of that buffer.
    """
    runs[0].check(rows, len(rows.reward), len(runs))
    structs = (Sac * len(runs))(*(run.call.struct for run in runs))
    check_alike([*structs], step, rows.reward.dtype)
    losses = runs[0].call.result(len(rows.reward), len(runs), 3)
    for k, struct in enumerate(structs):
        for name, part in zip(Batch._fields, rows):
            setattr(struct, name, part[0, k].data_ptr())
        struct.alpha, struct.gamma, struct.losses = alpha, gamma, losses[0, k].data_ptr()
    _updates("sac_updates", runs[0].call, [structs, len(runs), len(losses)], step, losses.dtype)
    return losses


class NativeDynamics:
    """`coim.objectives.dynamics_gradients.dynamics_gradients` of one member, written where an optimiser reads them.

    It holds the addresses of all tensors that it is made with: they must stay where they are.

    Args:
        network: contiguous tensors on the CPU, all of one dtype, as are the next ones.
        gradients: weight, bias, weight, bias, ..., to be written over.
        x: inputs of the shape that all others will have, ``[B, F]``.
        target: likewise, ``[B, S]``.
        log_var_range: soft bounds of the log-variance.
        threads: on which to compute.

    Raises:
        TypeError: as `NativeSAC`.
        ValueError: likewise.
        RuntimeError: likewise.
    """

    def __init__(
        self,
        network: Network,
        gradients: Sequence[Tensor],
        x: Tensor,
        target: Tensor,
        *,
        log_var_range: tuple[float, float],
        threads: int = 1,
    ) -> None:
        weights = network.weights[0]
        (size, features), entries = x.shape, target.shape[-1]
        check_counts(size, threads)
        check_network("ensemble", network, features, 2 * entries, weights)
        check_gradients([network], gradients)
        self._shapes, self._dtype = ((size, features), (size, entries)), weights.dtype
        self.check(x, target)
        self.call = Call(
            library(),
            "dynamics",
            weights,
            Dynamics(
                team=team() if threads > 1 else None,
                threads=threads,
                batch=size,
                layers=len(network.weights),
                layer=layers_of([network], [list(gradients)]),
                low=log_var_range[0],
                high=log_var_range[1],
            ),
        )

    def __call__(self, x: Tensor, target: Tensor) -> Tensor:
        """Write the gradients; return J_p of Eq. 6, ``[1]``.

        Args:
            x: contiguous, of the shape and dtype of the first one.
            target: likewise.
        """
        struct = self.call.struct
        loss = self.call.result(1)
        struct.x, struct.target, struct.loss = x.data_ptr(), target.data_ptr(), loss.data_ptr()
        self.call()
        return loss

    def check(self, x: Tensor, target: Tensor, *lead: int) -> None:
        """Refuse rows of other shapes or dtypes than the first ones, with these dimensions before them."""
        for name, rows, shape in zip(("x", "target"), (x, target), self._shapes):
            check_tensor(name, rows, (*lead, *shape), self._dtype)


def dynamics_updates(members: Sequence[NativeDynamics], x: Tensor, target: Tensor, step: AdamStep) -> Tensor:
    """Compute gradients of all members and do one step of Adam, for one batch after the other.

    With several threads each takes members of its own, as far as there are enough of them.

    Args:
        members: M of them, of the same sizes, those of one run after those of the other, with gradients in one flat
            buffer that ``step`` reads.
        x: contiguous inputs, ``[U, K, B, F]``, of the dtype of those that the members were made with.
        target: likewise, ``[U, K, B, S]``.
        step: without targets; its count of steps is not changed.

    Returns:
        J_p of Eq. 6 for each member, ``[U, M]``.

    Raises:
        ValueError: if rows have another shape or dtype, or are not contiguous; if the members differ in their sizes or
            are not as many for each run, or a gradient is not of that buffer.
    """
    updates, runs = x.shape[:2]
    members[0].check(x, target, updates, runs)
    if len(members) % runs:
        raise ValueError(f"{len(members)} members are not those of {runs} runs; give as many for each run")
    structs = (Dynamics * len(members))(*(member.call.struct for member in members))
    check_alike([*structs], step, x.dtype)
    losses = members[0].call.result(updates, len(members))
    for m, struct in enumerate(structs):
        run = m * runs // len(members)
        struct.x, struct.target = x[0, run].data_ptr(), target[0, run].data_ptr()
        struct.loss = losses[0, m].data_ptr()
    _updates("dynamics_updates", members[0].call, [structs, len(members), runs, updates], step, losses.dtype)
    return losses


def _updates(name: str, call: Call, arguments: Sequence[Any], step: AdamStep, dtype: torch.dtype) -> None:
    """Call a function that asks for memory if it is given none."""
    function = getattr(library(), f"{name}_{NUMBERS[dtype]}")
    function.restype = ctypes.c_int64
    given = [ctypes.c_int64(one) if isinstance(one, int) else one for one in arguments]
    needed = function(*given, ctypes.byref(step), None)
    function(*given, ctypes.byref(step), ctypes.c_void_p(call.memory(needed)))


def _split(tensors: Sequence[Tensor], counts: Sequence[int]) -> list[Sequence[Tensor]]:
    ends = [sum(counts[: at + 1]) for at in range(len(counts))]
    return [tensors[end - count : end] for count, end in zip(counts, ends)]
