"""Updates by Adam over one flat buffer of weights, which CUDA captures as a graph and replays."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import optimizer

from coim.objectives.native_structures import AdamStep, check_tensor

# One graph repeats so many updates: launched one by one, small networks wait for Python between them.
PER_GRAPH = 50


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
        state = self.moments()
        if group["amsgrad"] and "max_exp_avg_sq" not in state:
            state["max_exp_avg_sq"] = torch.zeros_like(weights)
        state["step"] += 1
        beta1, beta2 = group["betas"]
        kernel = torch._fused_adamw_ if group["decoupled_weight_decay"] else torch._fused_adam_
        kernel(
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

    def is_plain(self) -> bool:
        """Whether a step does what Adam's equations say and nothing else: nobody looks on, by a hook or a scheduler."""
        (group,) = self.param_groups
        hooks = self._optimizer_step_pre_hooks, self._optimizer_step_post_hooks
        everywhere = optimizer._global_optimizer_pre_hooks, optimizer._global_optimizer_post_hooks
        return not (any(hooks) or any(everywhere) or "step" in vars(self) or group["amsgrad"] or group["maximize"])

    def moments(self) -> dict[str, Tensor]:
        """The state of the weights, made where there is none yet."""
        (weights,) = self.param_groups[0]["params"]
        state = self.state[weights]
        if not state:
            state["step"] = torch.zeros((), device=weights.device)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(weights), torch.zeros_like(weights)
        return state

    def as_native(self, targets: Tensor | None = None, tau: float = 1.0) -> AdamStep:
        """The next step as native code takes it; it does not count it.

        Args:
            targets: flat, they follow the last weights; None if there are none.
            tau: share of the weights that moves into them.
        """
        (group,) = self.param_groups
        (weights,), moments = group["params"], self.moments()
        targets = weights[:0] if targets is None else targets
        for name in ("exp_avg", "exp_avg_sq"):
            check_tensor(name, moments[name], tuple(weights.shape), weights.dtype)
        return AdamStep(
            weights=weights.data_ptr(),
            gradient=weights.grad.data_ptr(),
            first=moments["exp_avg"].data_ptr(),
            second=moments["exp_avg_sq"].data_ptr(),
            targets=targets.data_ptr(),
            count=len(weights),
            followed=len(targets),
            lr=float(group["lr"]),
            beta1=group["betas"][0],
            beta2=group["betas"][1],
            eps=group["eps"],
            decay=group["weight_decay"],
            tau=tau,
            decoupled=group["decoupled_weight_decay"],
            steps=float(moments["step"]),
        )


class Graph:
    """A function of tensors on CUDA that is called once, captured in the second call and replayed from then on.

    Whatever is made once, such as Adam's moments, is made in the first call. (`tensordict.nn.CudaGraphModule` does the
    same for any function; its first use takes TensorDict out of torch's PyTree for good, for all code in the process.)

    Args:
        function: does the same operations in each call, on tensors of the same sizes, and returns a tensor. It changes
            other tensors in place only.
        device: of all tensors.
    """

    def __init__(self, function: Callable[..., Tensor], *, device: torch.device) -> None:
        self._function, self._device = function, device
        # torch's own stream for captures is one of the device that captured first in the process.
        self._aside = torch.cuda.Stream(device)
        self._warm = False
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self, *inputs: Tensor) -> Tensor:
        with torch.cuda.device(self._device):
            if not self._warm:
                return self._call_aside(inputs)
            if self._graph is None:
                self._capture(inputs)
            else:
                torch._foreach_copy_(self._inputs, list(inputs))
            assert self._graph is not None
            self._graph.replay()
            return self._output.clone()

    def _call_aside(self, inputs: Iterable[Tensor]) -> Tensor:
        """Call on another stream, as `torch.cuda.CUDAGraph` asks for: libraries make their workspaces then."""
        here = torch.cuda.current_stream()
        self._aside.wait_stream(here)
        with torch.cuda.stream(self._aside), warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*without CUDA graph capture")  # Adam's; the next call captures
            output = self._function(*inputs)
        here.wait_stream(self._aside)
        output.record_stream(here)  # it was allocated for the other stream, and is read on this one
        self._warm = True
        return output

    def _capture(self, inputs: Iterable[Tensor]) -> None:
        self._inputs = [x.clone() for x in inputs]
        graph = torch.cuda.CUDAGraph()
        # What other threads of the process do on the device is none of this graph's.
        with torch.cuda.graph(graph, stream=self._aside, capture_error_mode="thread_local"):
            self._output = self._function(*self._inputs)
        self._graph = graph


class FlatUpdates:
    """Updates by Adam over one flat buffer of weights; on CUDA they are captured as a graph and replayed.

    A graph repeats the operations that it has recorded. A number that may change between two calls is therefore read
    from a tensor, as the learning rate is; after any other change the next updates are captured anew.

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
        self._update = update
        self.captures = captures(weights.device)
        # Adam's fused kernel on CUDA reads it in float32, whatever the weights are.
        self._lr = torch.tensor(lr, dtype=torch.float32, device=weights.device) if self.captures else lr
        self._graphs: dict[tuple[tuple[torch.Size, torch.dtype], ...], Graph] = {}
        self._captured: object = None
        self.optimiser = (torch.optim.Adam if self.captures else FlatAdam)(
            [weights], lr=self._lr, weight_decay=weight_decay, fused=True, capturable=self.captures
        )

    def mean(self, batches: Iterable[Tensor]) -> Tensor:
        """Do an update with each batch, and return the mean of what the updates return.

        Args:
            batches: tensors ``[U, ...]``, the same rows of each are a batch.
        """
        self._weights.grad = self._gradient  # `optimiser.zero_grad()` takes it away
        if not self.captures:
            return self._one_by_one(*batches).mean(0)
        self._renew()
        parts = [self._graph(part)(*part) for part in zip(*(x.split(PER_GRAPH) for x in batches))]
        self._captured = self._constants()
        return torch.cat(parts).mean(0)

    def _one_by_one(self, *batches: Tensor) -> Tensor:
        return torch.stack([self._update(*rows) for rows in zip(*batches)])

    def _graph(self, batches: Iterable[Tensor]) -> Graph:
        """The graph for batches of these sizes and types, so many of them."""
        sizes = tuple((x.shape, x.dtype) for x in batches)
        if sizes not in self._graphs:
            self._graphs[sizes] = Graph(self._one_by_one, device=self._weights.device)
        return self._graphs[sizes]

    def _renew(self) -> None:
        """Write a new learning rate where the graphs read it; drop graphs of other settings or moments."""
        group = self.optimiser.param_groups[0]
        if group["lr"] is not self._lr:
            self._lr.copy_(torch.as_tensor(group["lr"]))  # type: ignore[union-attr]
            group["lr"] = self._lr
        if self._captured != self._constants():
            self._graphs.clear()

    def _constants(self) -> tuple[Any, ...]:
        """List what a graph assumes: where the moments lie, all settings but the learning rate."""
        moments = [moment.data_ptr() for moment in self.optimiser.state.get(self._weights, {}).values()]
        settings = self.optimiser.param_groups[0].items()
        return moments, {name: value for name, value in settings if name not in ("params", "lr")}


def captures(device: torch.device) -> bool:
    """Whether updates on a device are captured as a graph."""
    return device.type == "cuda"
