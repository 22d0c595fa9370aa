"""The model-free learner of Algorithm 1: networks, loss, optimiser and target update as one thing.

`coim.objectives.CoImSACLoss` says what is learnt; `coim.objectives.gradients` computes its gradients faster. All
weights lie in one flat buffer, all targets in another, so that Adam and the target update are one operation each, and
the modules' parameters are views of them: whoever holds the policy holds the one that learns.

Shapes: U updates, B batch, K runs, N critics, A action.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Eq. 7-8, Algorithm 1 and Sec. 6.1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate

from coim.compiling import compiled
from coim.learners.flat_weights import (
    FlatUpdates,
    Precision,
    by_run,
    captures,
    check_sizes,
    load_moments,
    moments_by_run,
    on_device,
    save_alone,
    share_storage,
    views,
)
from coim.learners.written_out import check_exchangeable, check_sac_networks, check_sac_rows
from coim.models.policy import LOG_SCALE_RANGE, Policy
from coim.models.qvalue import QValue
from coim.models.stacked import StackedMLP
from coim.objectives.functional import mixing_weights
from coim.objectives.gradients import Batch, Network, SACGradients, sac_gradients
from coim.objectives.runs import by_update
from coim.objectives.sac import CoImSACLoss
from coim.randomness import restore_generator


class SACLearner:
    """Policy and critics that learn with Eq. 7-8, and with Eq. 3-4 where nothing in the batch is imagined.

    Args:
        policy: ``pi(a | s, xi)``, on its device and in its dtype already.
        qvalue: the critics ``Q(s, a, xi)``, likewise.
        alpha: entropy temperature.
        gamma: discount.
        tau: share of the critics that moves into their targets after each update.
        lr: Adam's learning rate, the same for policy and critics.
        mix: how imagined rows enter the losses, see `coim.objectives.CoImSACLoss`.
        num_runs: K when the networks are stacked along the run axis.
        precision: ``"bfloat16"`` takes the networks' products in bfloat16; weights, moments, targets and losses stay as
            they are.
        compile: compile the gradients by `torch.compile` in the first update; results differ by rounding.
        seed: seeds the learner's own generator, from which every policy noise is drawn.

    Attributes:
        loss: the `CoImSACLoss` over the same parameters, for those who want its value or its gradients.
        optimiser: Adam over the flat buffer of all weights.  Its settings, ``tau``, ``loss.alpha`` and ``loss.gamma``
            may be changed at any time; the next update follows.

    Raises:
        ValueError: if ``precision`` is unknown, a number is out of its range, ``num_runs`` is not the networks', or
            policy and critics scale their inputs differently or have not one device and dtype.
        TypeError: if a network computes anything else than those of `coim.models` do, such as another activation.

    Note:
        On CUDA an update is captured as a CUDA graph and replayed, until batches have another size.  Where the
        gradients are compiled, all batches must have one size.

        Moving the modules to another device or dtype afterwards, or giving them to another learner, parts them from the
        flat buffers; `update` refuses that.

    Example:
        >>> import torch
        >>> from coim import HopperMorph, make_policy, make_qvalue
        >>> env = HopperMorph(num_runs=1, seed=0)
        >>> learner = SACLearner(make_policy(env, num_cells=(8,)), make_qvalue(env, num_cells=(8,)))
        >>> rows = env.rollout(6).reshape(3, 2)  # three updates with batches of two rows
        >>> learner.update(rows)["loss_qvalue"].shape
        torch.Size([1])
    """

    def __init__(
        self,
        policy: Policy,
        qvalue: QValue,
        *,
        alpha: float = 0.01,
        gamma: float = 0.99,
        tau: float = 0.005,
        lr: float = 3e-4,
        mix: Literal["batch", "sum"] = "batch",
        num_runs: int | None = None,
        precision: Precision = "float32",
        compile: bool = False,
        seed: int = 0,
    ) -> None:
        if precision not in ("float32", "bfloat16"):
            raise ValueError(f"precision={precision!r} is unknown; choose 'float32' or 'bfloat16'")
        if not 0 < tau <= 1:
            raise ValueError(f"tau={tau} is outside (0, 1]; Sec. 6.1 has 0.005")
        check_sac_networks(policy, qvalue)
        self.policy, self.qvalue = policy, qvalue
        self.loss = CoImSACLoss(policy, qvalue, alpha=alpha, gamma=gamma, mix=mix, num_runs=num_runs)
        SoftUpdate(self.loss, tau=tau)  # starts the targets at the critics, and tells TorchRL that they are cared for
        self.tau, self.num_runs = tau, num_runs
        self._lay_out(policy.network.mlp, qvalue.module.mlp, precision)
        device = self._weights.device
        self._find = compiled(sac_gradients, device) if compile else sac_gradients
        # A number would become a constant of what is compiled or captured. That reads these, renewed before updates;
        # torch.compile takes a float64 scalar without a dimension for such a number, and fails.
        read = ("alpha", "gamma", "tau") if captures(device) else ("alpha", "gamma") if compile else ()
        self._read_numbers = {name: self._weights.detach().new_empty(1) for name in read}
        self._updates = FlatUpdates(self._update_once, self._weights, lr=lr)
        self.optimiser = self._updates.optimiser
        self.rng = torch.Generator(self._weights.device).manual_seed(seed)

    @torch.no_grad()
    def start_from(self, other: SACLearner) -> None:
        """Take the other learner's weights, targets included, with an optimiser that has seen nothing (Algorithm 1).

        Raises:
            ValueError: if that one's networks have other sizes or scale their inputs differently.
        """
        check_exchangeable((self.policy, self.qvalue), (other.policy, other.qvalue))
        self._weights.copy_(other._weights)
        self._targets.copy_(other._targets)
        # In place: a captured CUDA graph goes on writing to these very moments.
        for state in self.optimiser.state.values():
            for moment in state.values():
                moment.zero_()

    def state_dict(self) -> dict[str, Any]:
        """Return what learning has changed: weights, targets, moments, generator. Tensors are not copied."""
        moments = dict(self.optimiser.state.get(self._weights, {}))
        weights, targets = self._weights.detach(), self._targets
        return {"weights": weights, "targets": targets, "moments": moments, "rng": self.rng.get_state()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on as the learner that :meth:`state_dict` was read from.

        Raises:
            ValueError: if that one's networks have other sizes; nothing is changed then.
        """
        own = {"weights": self._weights.detach(), "targets": self._targets}
        check_sizes(own, state_dict)
        for name, tensor in own.items():
            tensor.copy_(state_dict[name])
        load_moments(self.optimiser, self._weights, state_dict["moments"])
        restore_generator(self.rng, state_dict["rng"])

    def weights_by_run(self) -> list[Tensor]:
        """Weights and targets, each with the run axis first, ``[K, ...]``: views, not copies."""
        critics = [*self.qvalue.module.mlp.parameters()]
        return [
            *by_run(self._weights, self._parameters(), self.num_runs),
            *by_run(self._targets, critics, self.num_runs),
        ]

    def moments_by_run(self) -> list[Tensor]:
        """Adam's moments, as `weights_by_run` has the weights; none before its first step."""
        return moments_by_run(self.optimiser, self._weights, self._parameters(), self.num_runs)

    def check_networks_lie_here(self) -> None:
        """Refuse to go on with networks that were moved, or given to another learner, after this one was made.

        Raises:
            RuntimeError: if the networks' weights no longer lie in the flat buffer.
        """
        lies_at = {parameter.data_ptr() for parameter in self._parameters()}
        if lies_at != {view.data_ptr() for view in views(self._weights, self._parameters())}:
            raise RuntimeError("the networks were moved after their learner was made; make the learner last")

    def _parameters(self) -> list[Tensor]:
        return [*self.policy.network.mlp.parameters(), *self.qvalue.module.mlp.parameters()]

    @torch.no_grad()
    def update(self, batches: TensorDictBase) -> TensorDict:
        """One optimiser step and one target update per batch.

        Args:
            batches: rows in the transition schema, on any device; left untouched.  ``[B, K]`` is one batch and
                ``[U, B, K]`` one for each of U updates.  A single run may leave its axis away: ``[B]``, and with
                ``num_runs=None`` ``[U, B]``, batches of two rows or more.

        Returns:
            ``loss_actor``, ``loss_qvalue`` and ``entropy`` of each run, ``[K]``: means over the U updates.

        Raises:
            ValueError: if the rows have another shape, there are none, or they have what only the loss knows: several
                steps to the next observation, importance weights.
            RuntimeError: if the networks' weights no longer lie in the flat buffer.
        """
        batches = by_update(batches, self.num_runs)
        check_sac_rows(batches, self.loss.tensor_keys)
        self.check_networks_lie_here()
        for name, tensor in self._read_numbers.items():
            tensor.fill_(self._numbers()[name])
        rows = self._arrange(on_device(batches, self._weights.device))
        means = self._updates.mean([x[u] for x in rows] for u in range(len(batches)))
        return TensorDict(dict(zip(("loss_actor", "loss_qvalue", "entropy"), means)), means.shape[1:])

    def _update_once(self, *rows: Tensor) -> Tensor:
        """One update with the rows of a `Batch`, ``[K, B, ...]``; losses and entropy of each run, ``[3, K]``."""
        if self._read_weights.dtype != self._weights.dtype:
            self._read_weights.copy_(self._weights)
            self._read_targets.copy_(self._targets)
        numbers = self._numbers() | self._read_numbers
        found = [
            self._find(
                *networks,
                Batch(*(x[run] for x in rows)) if self._one_by_one else Batch(*rows),
                alpha=numbers["alpha"],
                gamma=numbers["gamma"],
                log_scale_range=LOG_SCALE_RANGE,
            )
            for run, networks in enumerate(self._networks)
        ]
        self._collect(found)
        self.optimiser.step()
        self._targets.lerp_(self._weights[-len(self._targets) :], numbers["tau"])
        return torch.stack([torch.stack([g.loss_actor, g.loss_qvalue, g.entropy]) for g in found], -1).reshape(3, -1)

    def _numbers(self) -> dict[str, Any]:
        return {"alpha": self.loss.alpha, "gamma": self.loss.gamma, "tau": self.tau}

    # -- one flat buffer, and views of it ------------------------------------------------------------------------------

    def _lay_out(
        self, policy: StackedMLP, critics: StackedMLP, precision: Precision, *, stack_runs: bool | None = None
    ) -> None:
        """Move all weights into one flat buffer and all targets into another, critics last and in the same order.

        A CPU multiplies the matrices of one network after the other; a GPU takes all runs in one product.
        """
        own = [*policy.parameters(), *critics.parameters()]
        keys = [tuple(name.split(".")) for name, _ in self.qvalue.named_parameters()]
        targets = [self.loss.target_qvalue_params.get(key) for key in keys]
        self._weights = nn.Parameter(share_storage(own))
        for network in (policy, critics):
            save_alone(network)
        self._weights.grad = torch.zeros_like(self._weights.detach())
        self._targets = share_storage(targets)
        # Products read these: the weights themselves, or copies in bfloat16 that every update renews.
        self._read_weights, self._read_targets = self._weights.detach(), self._targets
        if precision == "bfloat16":
            self._read_weights = self._read_weights.to(torch.bfloat16)
            self._read_targets = self._read_targets.to(torch.bfloat16)
        read, target_views = views(self._read_weights, own), views(self._read_targets, targets)
        policy_views, critic_views = read[: -len(targets)], read[-len(targets) :]
        gradients = views(self._weights.grad, own)
        policy_gradients, critic_gradients = gradients[: -len(targets)], gradients[-len(targets) :]
        stack_runs = self._weights.device.type != "cpu" if stack_runs is None else stack_runs
        self._one_by_one = self.num_runs is None or not stack_runs
        runs: list[Any] = [()]  # where a network of one run, or of all of them, lies in stacked weights
        if self.num_runs is not None:
            runs = [(slice(None),)] if stack_runs else [(run,) for run in range(self.num_runs)]
        copies = range(critics.num_copies or 1)
        self._networks = [
            (
                _network(policy_views, run),
                [_network(critic_views, (*run, n)) for n in copies],
                [_network(target_views, (*run, n)) for n in copies],
            )
            for run in runs
        ]
        self._gradients = [
            ([g[run] for g in policy_gradients], [[g[(*run, n)] for g in critic_gradients] for n in copies])
            for run in runs
        ]

    def _arrange(self, batches: TensorDictBase) -> Batch:
        """Bare tensors ``[U, K, B, ...]``, the run axis before the batch, with fresh noise and the rows' weights."""
        runs = self.num_runs or 1
        noise, next_noise = (self._noise(batches["action"]) for _ in range(2))
        imagined = batches.get("imagined", None)
        if imagined is None:
            imagined = torch.zeros_like(batches["next", "terminated"])

        def by_run(x: Tensor) -> Tensor:
            return x.reshape(len(x), -1, runs, x.shape[-1]).transpose(1, 2).contiguous()

        def number(x: Tensor) -> Tensor:
            """One of each row, with a dimension of its own or without."""
            return by_run(x.reshape(*batches.batch_size, 1)).squeeze(-1)

        def scaled(rows: TensorDictBase) -> tuple[Tensor, Tensor]:
            """Observation and design as the networks' first layers see them."""
            scaling = self.policy.network.scaling
            inputs = rows["observation"], batches["design"]
            observation, design = inputs if scaling is None else scaling(*inputs)
            return by_run(observation), by_run(design)

        flags = number(imagined)
        weight = [mixing_weights(flag.mT, self.loss.mix, dtype=noise.dtype).mT for flag in flags]
        after = batches["next"]
        observation, design = scaled(batches)
        return Batch(
            observation=observation,
            design=design,
            action=by_run(batches["action"]),
            next_observation=scaled(after)[0],
            reward=number(after["reward"]),
            terminated=number(after["terminated"]),
            noise=by_run(noise),
            next_noise=by_run(next_noise),
            weight=torch.stack(weight),
        )

    def _noise(self, action: Tensor) -> Tensor:
        return torch.randn(action.shape, generator=self.rng, dtype=action.dtype, device=action.device)

    def _collect(self, found: list[SACGradients]) -> None:
        """Write gradients where Adam reads them."""
        for (policy, critics), gradients in zip(self._gradients, found):
            torch._foreach_copy_(policy, gradients.policy)
            for own, gradient in zip(critics, gradients.critics):
                torch._foreach_copy_(own, gradient)


def _network(layers: Sequence[Tensor], index: Any) -> Network:
    """One network, or one for each run, out of stacked weights and biases."""
    return Network([weight[index] for weight in layers[0::2]], [bias[index] for bias in layers[1::2]])
