"""Updates by Adam over one flat buffer of weights, which CUDA captures as a graph and replays."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from tensordict.nn import CudaGraphModule
from torch import Tensor, nn


class FlatAdam(torch.optim.Adam):
    """Adam over one tensor on the CPU, by the same kernel and to the same bits as `torch.optim.Adam`.

    With small networks `torch.optim.Adam` takes longer to sort its tensors than to change them: a step of 30,000
    weights takes 64 us here and 93 there. Hooks and schedulers work as usual.
    """

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Do one step."""
        (group,) = self.param_groups
        (weights,) = group["params"]
        state = self.state[weights]
        if not state:
            state["step"] = torch.zeros((), device=weights.device)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(weights), torch.zeros_like(weights)
        if group["amsgrad"] and "max_exp_avg_sq" not in state:
            state["max_exp_avg_sq"] = torch.zeros_like(weights)
        state["step"] += 1
        beta1, beta2 = group["betas"]
        torch._fused_adam_(
            [weights],
            [weights.grad],
            [state["exp_avg"]],
            [state["exp_avg_sq"]],
            [state["max_exp_avg_sq"]] if group["amsgrad"] else [],
            [state["step"]],
            beta1=beta1,
            beta2=beta2,
            **{name: group[name] for name in ("lr", "weight_decay", "eps", "amsgrad", "maximize")},
        )


class FlatUpdates:
    """Updates by Adam over one flat buffer of weights; on CUDA one is captured as a graph and replayed.

    A graph repeats the operations that it has recorded. A number that may change between two calls is therefore read
    from a tensor, as the learning rate is; after any other change the next update is captured anew.

    Args:
        update: computes gradients from the tensors of one batch, writes them into ``weights.grad``, calls
            ``optimiser.step()`` and returns losses.
        weights: the flat buffer, with a gradient that is written in place.
        lr: learning rate.
        weight_decay: L2 penalty.

    Attributes:
        optimiser: Adam. All of its settings can be changed at any time, by hand or by a scheduler.
        captures: whether updates are captured.
    """

    def __init__(
        self, update: Callable[..., Tensor], weights: nn.Parameter, *, lr: float, weight_decay: float = 0.0
    ) -> None:
        assert weights.grad is not None
        self._weights, self._gradient = weights, weights.grad
        self._update = self._step = update
        self.captures = captures(weights.device)
        # Adam's fused kernel on CUDA reads it in float32, whatever the weights are.
        self._lr = torch.tensor(lr, dtype=torch.float32, device=weights.device) if self.captures else lr
        self._captured: object = None
        self.optimiser = (torch.optim.Adam if self.captures else FlatAdam)(
            [weights], lr=self._lr, weight_decay=weight_decay, fused=True, capturable=self.captures
        )

    def mean(self, batches: Iterable[Sequence[Tensor]]) -> Tensor:
        """Do one update with the tensors of each batch, and return the mean of what the updates return."""
        batches = list(batches)
        sizes = [tensor.shape for tensor in batches[0]]
        self._weights.grad = self._gradient  # `optimiser.zero_grad()` takes it away
        if self.captures:
            self._renew(sizes)
        with torch.cuda.device_of(self._weights):  # a graph is captured on the current device
            mean = torch.stack([self._step(*rows) for rows in batches]).mean(0)
        if self.captures:
            self._captured = self._constants(sizes)
        return mean

    def _renew(self, sizes: list[torch.Size]) -> None:
        """Write a new learning rate where the graph reads it; drop a graph of other sizes, settings or moments."""
        group = self.optimiser.param_groups[0]
        if group["lr"] is not self._lr:
            self._lr.copy_(torch.as_tensor(group["lr"]))  # type: ignore[union-attr]
            group["lr"] = self._lr
        if self._captured != self._constants(sizes):
            self._step = CudaGraphModule(self._update, device=self._weights.device)

    def _constants(self, sizes: list[torch.Size]) -> tuple[Any, ...]:
        """List what a graph assumes: sizes, where the moments lie, all settings but the learning rate."""
        moments = [moment.data_ptr() for moment in self.optimiser.state.get(self._weights, {}).values()]
        settings = self.optimiser.param_groups[0].items()
        return sizes, moments, {name: value for name, value in settings if name not in ("params", "lr")}


def captures(device: torch.device) -> bool:
    """Whether updates on a device are captured as a graph."""
    return device.type == "cuda"
