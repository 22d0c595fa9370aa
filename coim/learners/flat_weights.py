"""Weights in one flat buffer: what the learners share.

Adam and a target update are one operation each over a flat buffer, and the networks' parameters are views of it:
whoever holds a network holds the one that learns.

Shapes: N weights, K runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn

from coim.compiling import Compiled
from coim.learners.captured import FlatAdam, FlatUpdates
from coim.objectives.native_gradients import pays

Precision = Literal["float32", "bfloat16"]
AT_ONCE = 50  # native updates of all networks in a call: only between calls does Python hear Ctrl-C
WAY_OUT = (
    "make it with the hidden units, the number of critics or members and the number of runs that the state was saved "
    "with"
)


class FlatLearner:
    """Networks whose weights lie in one flat buffer, with Adam over it and a state that can be saved.

    A subclass writes `_update_once`, which computes one update and returns its losses, and calls `_mean` to do many.

    Args:
        networks: by name, in the order in which their weights are laid out; on their device and in their dtype already.
        gradients: a function of networks and rows, which may be compiled.
        lr: learning rate.
        weight_decay: L2 penalty of Adam.
        num_runs: K when the networks are stacked along the run axis.
        precision: ``"bfloat16"`` has the products read a copy of the weights in bfloat16; the weights stay as they are.
        compile: compute the updates by compiled code, made in the first one: native code on a CPU, where it is
            known to be faster, see `coim.objectives.native_gradients.pays`; elsewhere that of `torch.compile`.
        of_ensemble: whether the network is an ensemble, whose layers may be wider there.

    Attributes:
        num_runs: K, or None.
        native: whether gradients are computed in native code, and whole updates with `FlatAdam` as it is.
        optimiser: Adam over the flat buffer. Its settings may be changed at any time; the next update follows.

    Raises:
        ValueError: if ``precision`` is unknown.

    Note:
        Moving a network to another device or dtype afterwards, or giving it to another learner, parts it from the flat
        buffer; so does a deep copy of the learner. An update refuses that.

    Example:
        >>> from coim import DynamicsLearner, GaussianEnsemble, HopperMorph
        >>> env = HopperMorph(num_runs=1, seed=0)
        >>> one, other = (DynamicsLearner(GaussianEnsemble.for_env(env, num_cells=(8,))) for _ in range(2))
        >>> other.load_state_dict(one.state_dict())
        >>> torch.equal(one.weights_by_run()[0], other.weights_by_run()[0])
        True
    """

    def __init__(
        self,
        networks: Mapping[str, nn.Module],
        gradients: Callable[..., Any],
        *,
        lr: float,
        weight_decay: float = 0.0,
        num_runs: int | None,
        precision: Precision,
        compile: bool,
        of_ensemble: bool = False,
    ) -> None:
        if precision not in get_args(Precision):
            raise ValueError(f"precision={precision!r} is unknown; choose 'float32' or 'bfloat16'")
        self.num_runs, self._laid_out = num_runs, dict(networks)
        self._weights = nn.Parameter(share_storage(self._parameters()))
        self._weights.grad = self._gradient = torch.zeros_like(self._weights.detach())
        for network in networks.values():
            save_alone(network)
        # Products read these: the weights themselves, or a copy in bfloat16 that every update renews.
        self._read_weights = in_precision(self._weights.detach(), precision)
        self._updates = FlatUpdates(self._update_once, self._weights, lr=lr, weight_decay=weight_decay)
        self.optimiser = self._updates.optimiser
        on_cpu = self._weights.device.type == "cpu"
        self.native = (
            compile and on_cpu and precision == "float32" and pays(self._parameters(), of_ensemble=of_ensemble)
        )
        self._compiled = Compiled(gradients) if compile and not on_cpu else None
        self._plain: Callable[..., Any] = gradients
        self._code: dict[int, Any] = {}  # while updates are done

    def state_dict(self) -> dict[str, Any]:
        """Return what learning has changed, and the shapes of the weights by name. Tensors are not copied."""
        return self._buffers() | {"moments": dict(self._moments()), "shapes": shapes_of(self._laid_out)}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on as the learner that :meth:`state_dict` was read from.

        A state without shapes, from before they were saved, is compared by its number of weights alone.

        Raises:
            ValueError: if the networks of that learner have other sizes; nothing is changed then.
        """
        own = self._buffers()
        check_state(state_dict, own, shapes_of(self._laid_out))
        for name, tensor in own.items():
            tensor.copy_(state_dict[name])
        self._load_moments(state_dict["moments"])

    def weights_by_run(self) -> list[Tensor]:
        """Weights with the run axis first, ``[K, ...]``: views, not copies."""
        return self._by_run(self._weights.detach(), self._parameters())

    def moments_by_run(self) -> list[Tensor]:
        """Adam's moments, as `weights_by_run` has the weights; none before its first step."""
        moments = [moment for moment in self._moments().values() if moment.ndim]  # without the count of steps
        return [part for moment in moments for part in self._by_run(moment, self._parameters())]

    def check_networks_lie_here(self) -> None:
        """Refuse to go on with a network that was moved, or given to another learner, after this one was made.

        Raises:
            RuntimeError: if the weights of a network no longer lie in the flat buffer.
        """
        parts = self._parts(self._weights.detach())
        for name, network in self._laid_out.items():
            if any(one.data_ptr() != here.data_ptr() for one, here in zip(network.parameters(), parts[name])):
                raise RuntimeError(f"the {name} was moved after its learner was made; make the learner last")

    def _update_once(self, *rows: Tensor) -> Tensor:
        """Write the gradients of one batch to `_gradient`, call ``optimiser.step()`` and return the losses."""
        raise NotImplementedError

    def _mean(self, batches: Iterable[Tensor]) -> Tensor:
        """Do an update with each batch of tensors ``[U, ...]``, and return the mean of what `_update_once` returns."""
        try:
            return self._updates.mean(batches)
        finally:
            self._code.clear()

    def _all_native(self) -> bool:
        """Whether native code does all that an update does."""
        return self.native and isinstance(self.optimiser, FlatAdam) and self.optimiser.is_plain()

    def _natively(
        self, rows: Iterable[Tensor], networks: int, update: Callable[..., Tensor], **following: Any
    ) -> Tensor:
        """Do updates in calls of native code, and return the losses of all of them.

        Args:
            rows: ``[U, ...]``, of all updates.
            networks: how many a call updates.
            update: does those of one call, with its rows and the step of Adam that it begins with; returns losses,
                ``[U, ...]``.
            following: targets, see `FlatAdam.as_native`.
        """
        assert isinstance(self.optimiser, FlatAdam)
        self._weights.grad = self._gradient  # `optimiser.zero_grad()` takes it away
        found = []
        for part in zip(*(x.split(max(1, AT_ONCE // networks)) for x in rows)):
            step, counted = self.optimiser.as_native(**following), self.optimiser.moments()["step"]
            counted += len(part[0])  # first: Ctrl-C is heard when the call is over
            try:
                found.append(update(part, step))
            except Exception:  # refused, or no memory: nothing was done
                counted -= len(part[0])
                raise
        return torch.cat(found)

    def _find(self, *inputs: Any, **settings: Any) -> Any:
        """Call the gradients, compiled by `torch.compile` or not."""
        compiled = self._compiled
        code = self._plain if compiled is None else self._prepared(0, lambda: compiled.checked(*inputs, **settings))
        return code(*inputs, **settings)

    def _prepared(self, which: int, make: Callable[[], Any]) -> Any:
        """Code that looked at the first inputs of a `_mean`: all others have the same shapes."""
        if which not in self._code:
            self._code[which] = make()
        return self._code[which]

    def _renew(self) -> None:
        """Copy the weights to where products read them."""
        if self._read_weights.dtype != self._weights.dtype:
            self._read_weights.copy_(self._weights)

    def _buffers(self) -> dict[str, Tensor]:
        """Flat buffers that a state holds, by name."""
        return {"weights": self._weights.detach()}

    def _parameters(self) -> list[Tensor]:
        return [parameter for network in self._laid_out.values() for parameter in network.parameters()]

    def _parts(self, flat: Tensor) -> dict[str, list[Tensor]]:
        """Views of a buffer of N numbers in the shapes of the parameters, by network."""
        parts = iter(views(flat, self._parameters()))
        return {name: [next(parts) for _ in network.parameters()] for name, network in self._laid_out.items()}

    def _by_run(self, flat: Tensor, tensors: Sequence[Tensor]) -> list[Tensor]:
        """Consecutive parts of a buffer in the shapes of some tensors, with a run axis even if there is but one run."""
        found = views(flat, tensors)
        return found if self.num_runs is not None else [part.unsqueeze(0) for part in found]

    def _moments(self) -> dict[str, Tensor]:
        return self.optimiser.state.get(self._weights, {})

    def _load_moments(self, moments: Mapping[str, Tensor]) -> None:
        """Take moments; none are those of an Adam that has seen nothing.

        In place where there are some: a captured CUDA graph goes on writing to these very moments. Copied where there
        are none: `torch.optim.Optimizer.load_state_dict` would share them with whoever gave them.
        """
        state = self.optimiser.state[self._weights]
        for moment in state.values():
            moment.zero_()
        for name, moment in moments.items():
            if name in state:
                state[name].copy_(moment)
            else:
                # Adam counts its steps on the CPU, unless it can be captured in a graph.
                on_gpu = self.optimiser.defaults.get("capturable", False) or moment.ndim > 0
                dtype = self._weights.dtype if moment.ndim > 0 else moment.dtype
                state[name] = moment.detach().to(self._weights.device if on_gpu else "cpu", dtype, copy=True)


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


def in_precision(flat: Tensor, precision: Precision) -> Tensor:
    """Return what products read of a flat buffer: the buffer itself, or a copy in bfloat16."""
    return flat.to(torch.bfloat16) if precision == "bfloat16" else flat


@torch.no_grad()
def read_networks(networks: Mapping[str, nn.Module], state_dict: Mapping[str, Any]) -> None:
    """Read networks out of the state of a learner.

    Args:
        networks: by name, as the learner had them; their weights are written over.
        state_dict: as `FlatLearner.state_dict` returns it.

    Raises:
        ValueError: if the learner's networks have other sizes; nothing is changed then.
    """
    parameters = [parameter for network in networks.values() for parameter in network.parameters()]
    flat = torch.cat([parameter.reshape(-1) for parameter in parameters])
    check_state(state_dict, {"weights": flat}, shapes_of(networks))
    for parameter, values in zip(parameters, views(state_dict["weights"], parameters)):
        parameter.copy_(values)


def shapes_of(networks: Mapping[str, nn.Module]) -> dict[str, tuple[int, ...]]:
    """Shapes of all weights by name, in the order of the flat buffer.

    Example:
        >>> shapes_of({"policy": nn.Sequential(nn.Linear(5, 8))})
        {'policy.0.weight': (8, 5), 'policy.0.bias': (8,)}
    """
    return {
        f"{name}.{key}": tuple(parameter.shape)
        for name, network in networks.items()
        for key, parameter in network.named_parameters()
    }


def check_state(state: Mapping[str, Any], own: Mapping[str, Tensor], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Refuse a state of other networks before anything is copied.

    Args:
        state: as `FlatLearner.state_dict` returns it, with shapes or without.
        own: the flat buffers that are to be written over, by name.
        shapes: of the weights, by name.

    Raises:
        ValueError: naming the first weight that differs, or the number of weights if the state has no shapes.
    """
    theirs = state.get("shapes", shapes)
    for name in {**shapes, **theirs}:
        wanted, found = shapes.get(name, "missing"), theirs.get(name, "missing")
        if wanted != found:
            raise ValueError(f"{name} is {found} in the state and {wanted} in this learner; {WAY_OUT}")
    for name, tensor in own.items():
        if state[name].shape != tensor.shape:
            raise ValueError(
                f"the state holds {state[name].numel()} {name}, this learner has {tensor.numel()}; {WAY_OUT}"
            )


def save_alone(module: nn.Module) -> None:
    """Let ``state_dict`` return copies: saved, a view of the flat buffer would take the whole buffer along."""
    for part in module.modules():
        if next(part.parameters(recurse=False), None) is not None:
            part.register_state_dict_post_hook(_copied)


def _copied(module: nn.Module, state_dict: dict[str, Any], prefix: str, local_metadata: dict[str, Any]) -> None:
    for name, _ in module.named_parameters(recurse=False):
        if not isinstance(state_dict[prefix + name], nn.Parameter):  # as ``keep_vars=True`` wants them
            state_dict[prefix + name] = state_dict[prefix + name].clone()
