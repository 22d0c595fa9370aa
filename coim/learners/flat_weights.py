"""Weights in one flat buffer, and the updates of an optimiser over it, which CUDA replays as one graph.

Shapes: K runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import CudaGraphModule
from torch import Tensor, nn

Precision = Literal["float32", "bfloat16"]


class FlatUpdates:
    """Updates by Adam over one flat buffer of weights; on CUDA one is captured as a graph and replayed.

    A graph repeats what it saw. What may change between two calls is therefore read from tensors, as the learning rate
    is, or has the next update captured anew.

    Args:
        update: computes gradients, writes them into ``weights.grad`` and calls ``optimiser.step()``.
        weights: the flat buffer; its gradient is there already.
        lr: learning rate.
        weight_decay: L2 penalty.

    Attributes:
        optimiser: Adam. All of its settings can be changed at any time, by hand or by a scheduler.
    """

    def __init__(
        self, update: Callable[..., Tensor], weights: nn.Parameter, *, lr: float, weight_decay: float = 0.0
    ) -> None:
        assert weights.grad is not None
        self._weights, self._gradient = weights, weights.grad
        self._update = self._step = update
        self._captures = captures(weights.device)
        # Adam's fused kernel on CUDA reads it in float32, whatever the weights are.
        self._lr = torch.tensor(lr, dtype=torch.float32, device=weights.device) if self._captures else lr
        self._captured: object = None
        self.optimiser = torch.optim.Adam(
            [weights], lr=self._lr, weight_decay=weight_decay, fused=True, capturable=self._captures
        )

    def mean(self, batches: Iterable[Sequence[Tensor]]) -> Tensor:
        """Do one update with the tensors of each batch; returns the mean of what the updates return."""
        batches = list(batches)
        sizes = [tensor.shape for tensor in batches[0]]
        self._weights.grad = self._gradient  # `optimiser.zero_grad()` takes it away
        if self._captures:
            self._renew(sizes)
        with torch.cuda.device_of(self._weights):  # a graph is captured on the current device
            mean = torch.stack([self._step(*rows) for rows in batches]).mean(0)
        if self._captures:
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
        """What a graph takes for granted: sizes, where the moments lie, the settings but for the learning rate."""
        moments = [moment.data_ptr() for moment in self.optimiser.state.get(self._weights, {}).values()]
        settings = self.optimiser.param_groups[0].items()
        return sizes, moments, {name: value for name, value in settings if name not in ("params", "lr")}


def captures(device: torch.device) -> bool:
    """Whether updates on a device are captured as a graph."""
    return device.type == "cuda"


def on_device(rows: TensorDictBase, device: torch.device) -> TensorDictBase:
    """Rows where a learner is, as they are if they lie there: a replay may stay on the CPU."""
    return rows if rows["observation"].device == device else rows.to(device)


def share_storage(tensors: Sequence[Tensor]) -> Tensor:
    """Move tensors into one flat buffer, in place: each becomes a view of what is returned."""
    flat = torch.cat([tensor.detach().reshape(-1) for tensor in tensors])
    for tensor, view in zip(tensors, views(flat, tensors)):
        tensor.data = view
    return flat


def views(flat: Tensor, tensors: Sequence[Tensor]) -> list[Tensor]:
    """Consecutive parts of a flat buffer in the shapes of some tensors."""
    parts = flat[: sum(tensor.numel() for tensor in tensors)].split([tensor.numel() for tensor in tensors])
    return [part.view(tensor.shape) for part, tensor in zip(parts, tensors)]


def by_run(flat: Tensor, tensors: Sequence[Tensor], num_runs: int | None) -> list[Tensor]:
    """Consecutive parts of a flat buffer in the shapes of some tensors, with a run axis even where there is but one."""
    found = views(flat.detach(), tensors)
    return found if num_runs is not None else [part.unsqueeze(0) for part in found]


def moments_by_run(
    optimiser: torch.optim.Optimizer, weights: nn.Parameter, tensors: Sequence[Tensor], num_runs: int | None
) -> list[Tensor]:
    """Moments of an optimiser of one flat buffer, as :func:`by_run` has the buffer itself."""
    moments = [moment for moment in optimiser.state.get(weights, {}).values() if moment.ndim]
    return [part for moment in moments for part in by_run(moment, tensors, num_runs)]


def save_alone(module: nn.Module) -> None:
    """Let ``state_dict`` return copies: saved, a view of the flat buffer would take the whole buffer along."""
    for part in module.modules():
        if next(part.parameters(recurse=False), None) is not None:
            part.register_state_dict_post_hook(_copied)


def _copied(module: nn.Module, state_dict: dict[str, Any], prefix: str, local_metadata: dict[str, Any]) -> None:
    for name, _ in module.named_parameters(recurse=False):
        if not isinstance(state_dict[prefix + name], nn.Parameter):  # as ``keep_vars=True`` wants them
            state_dict[prefix + name] = state_dict[prefix + name].clone()


def check_sizes(own: Mapping[str, Tensor], given: Mapping[str, Tensor]) -> None:
    """Refuse a state of other networks before anything is copied."""
    for name, tensor in own.items():
        if given[name].shape != tensor.shape:
            raise ValueError(
                f"the state holds {given[name].numel()} {name}, this learner has {tensor.numel()}; make it with the "
                "sizes, the number of critics or members and the number of runs that the state was saved with"
            )


def load_moments(optimiser: torch.optim.Optimizer, parameter: nn.Parameter, moments: Mapping[str, Tensor]) -> None:
    """Take the moments of an optimiser of one parameter; none are those of one that has seen nothing.

    In place where there are some: a captured CUDA graph goes on writing to these very moments. Copied where there are
    none: `torch.optim.Optimizer.load_state_dict` would share them with whoever gave them.
    """
    state = optimiser.state[parameter]
    for moment in state.values():
        moment.zero_()
    for name, moment in moments.items():
        if name in state:
            state[name].copy_(moment)
        else:
            # Adam counts its steps on the CPU, unless it can be captured in a graph.
            on_gpu = optimiser.defaults.get("capturable", False) or moment.ndim > 0
            state[name] = moment.detach().to(parameter.device if on_gpu else "cpu", copy=True)
