"""The model-free learner of Algorithm 1: networks, loss, optimiser and target update as one thing.

`coim.objectives.CoImSACLoss` says what is learnt. `coim.objectives.gradients` computes its gradients faster and is what
trains; ``tests/objectives/test_gradients.py`` holds the two equal. All weights lie in one flat buffer and all targets
in another, so that Adam and the target update are one operation each.

Shapes: U updates, B batch, K runs, N critics.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Eq. 7-8, Algorithm 1 and Sec. 6.1.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from itertools import chain
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import SoftUpdate

from coim.learners.flat_weights import FlatLearner, Precision, in_precision, share_storage, views
from coim.learners.known_networks import check_exchangeable, check_sac_networks
from coim.learners.rows import check_sac_rows, on_device, sac_batch
from coim.models.policy import LOG_SCALE_RANGE, Policy
from coim.models.qvalue import QValue
from coim.objectives.gradients import Batch, Network, sac_gradients
from coim.objectives.native_gradients import NativeSAC, sac_updates
from coim.objectives.runs import by_update
from coim.objectives.sac import CoImSACLoss
from coim.randomness import restore_generator


class SACLearner(FlatLearner):
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
        precision: ``"bfloat16"`` computes the networks' products in bfloat16; weights, moments, targets and losses
            stay as they are.
        compile: compute the updates by compiled code, made in the first one; results differ by rounding. On a CPU
            that is native code, for weights of float32 or float64 and layers up to 256 units; all else there is as
            without.
        seed: seeds the learner's own generator, which draws all noise of the policy.

    Attributes:
        loss: the `CoImSACLoss` over the same parameters, for those who want its value or its gradients.
        optimiser: Adam over the flat buffer of all weights. Its settings, ``tau``, ``loss.alpha`` and ``loss.gamma``
            may be changed at any time; the next update follows.
        rng: the learner's own generator.

    Raises:
        ValueError: if ``precision`` is unknown, a number is out of its range, ``num_runs`` is not the networks', or
            policy and critics differ in device, dtype or the scaling of their inputs.
        TypeError: if a network computes anything else than those of `coim.models` do, such as another activation.

    Note:
        On CUDA fifty updates at once are captured as a CUDA graph and replayed, after the first fifty, which are
        launched one by one; a graph is kept for each size of batches. Where the gradients are compiled there, all
        batches must have one size.

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
        if not 0 < tau <= 1:
            raise ValueError(f"tau={tau} is outside (0, 1]; Sec. 6.1 has 0.005")
        check_sac_networks(policy, qvalue)
        self.policy, self.qvalue = policy, qvalue
        self.loss = CoImSACLoss(policy, qvalue, alpha=alpha, gamma=gamma, mix=mix, num_runs=num_runs)
        SoftUpdate(self.loss, tau=tau)  # starts the targets at the critics, and tells TorchRL that they are updated
        networks = {"policy": policy.network.mlp, "qvalue": qvalue.module.mlp}
        super().__init__(
            networks, sac_gradients_in_order, lr=lr, num_runs=num_runs, precision=precision, compile=compile
        )
        keys = [tuple(name.split(".")) for name, _ in qvalue.named_parameters()]
        self._targets = share_storage([self.loss.target_qvalue_params.get(key) for key in keys])
        self._read_targets = in_precision(self._targets, precision)
        one_by_one = num_runs is None or self._weights.device.type == "cpu"
        self._cut_networks(one_by_one=one_by_one)
        self.tau = tau
        # A number would become a constant of what is captured. That reads these, renewed before updates; torch.compile
        # takes a float64 scalar without a dimension for such a number, and fails.
        read = ("alpha", "gamma", "tau") if self._updates.captures else ()
        self._read_numbers = {name: self._weights.detach().new_empty(1) for name in read}
        self.rng = torch.Generator(self._weights.device).manual_seed(seed)

    @torch.no_grad()
    def start_from(self, other: SACLearner) -> None:
        """Take the other learner's weights and targets, and begin with a fresh optimiser (Algorithm 1).

        Raises:
            ValueError: if the other learner's networks have other sizes or scale their inputs differently.
        """
        check_exchangeable((self.policy, self.qvalue), (other.policy, other.qvalue))
        for name, tensor in self._buffers().items():
            tensor.copy_(other._buffers()[name])
        self._load_moments({})

    def state_dict(self) -> dict[str, Any]:
        """Return what learning has changed: weights, targets, moments, generator. Tensors are not copied."""
        return super().state_dict() | {"rng": self.rng.get_state()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on as the learner that :meth:`state_dict` was read from; see `FlatLearner.load_state_dict`."""
        super().load_state_dict(state_dict)
        restore_generator(self.rng, state_dict["rng"])

    def weights_by_run(self) -> list[Tensor]:
        """Weights and targets, each with the run axis first, ``[K, ...]``: views, not copies."""
        return super().weights_by_run() + self._by_run(self._targets, [*self.qvalue.module.mlp.parameters()])

    @torch.no_grad()
    def update(self, batches: TensorDictBase) -> TensorDict:
        """Do one optimiser step and one target update per batch.

        Args:
            batches: rows in the transition schema, on any device; left untouched. ``[B, K]`` is one batch and
                ``[U, B, K]`` one for each of U updates. A single run may omit its axis: ``[B]``, and with
                ``num_runs=None`` ``[U, B]``, batches of two rows or more.

        Returns:
            ``loss_actor``, ``loss_qvalue`` and ``entropy`` of each run, ``[K]``: means over the U updates.

        Raises:
            ValueError: if the rows have another shape, there are none, or they have an entry that only the loss knows:
                several steps to the next observation, importance weights.
            RuntimeError: if a network was moved since the learner was made.
        """
        batches = by_update(batches, self.num_runs)
        check_sac_rows(batches, self.loss.tensor_keys)
        self.check_networks_lie_here()
        for name, tensor in self._read_numbers.items():
            tensor.fill_(self._numbers()[name])
        batches = on_device(batches, self._weights.device)
        noise = self._noise(batches["action"]), self._noise(batches["action"])
        scaling = self.policy.network.scaling
        rows = sac_batch(batches, noise, scaling=scaling, mix=self.loss.mix, num_runs=self.num_runs)
        if self.native:  # what is not native takes the dtype of the networks where it multiplies
            rows = Batch(*(x if x.dtype == torch.bool else x.to(self._weights.dtype) for x in rows))
        means = self._mean(rows)
        return TensorDict(dict(zip(("loss_actor", "loss_qvalue", "entropy"), means)), means.shape[1:])

    def _mean(self, batches: Iterable[Tensor]) -> Tensor:
        """As `FlatLearner._mean`, in one call for many updates where native code does all that an update does."""
        if not self._all_native():
            return super()._mean(batches)
        rows = Batch(*batches)
        threads = torch.get_num_threads()
        runs = [
            NativeSAC(
                *networks, own, Batch(*(x[0, run] for x in rows)), log_scale_range=LOG_SCALE_RANGE, threads=threads
            )
            for run, (networks, own) in enumerate(zip(self._networks, self._gradients))
        ]
        alpha, gamma = float(self.loss.alpha), self.loss.gamma
        losses = self._natively(
            rows,
            len(runs),
            lambda part, step: sac_updates(runs, Batch(*part), step, alpha=alpha, gamma=gamma),
            targets=self._targets,
            tau=self.tau,
        )
        return losses.mean(0).mT

    def _update_once(self, *rows: Tensor) -> Tensor:
        """Do one update with the rows of a `Batch`, ``[K, B, ...]``; return losses and entropy, ``[3, K]``."""
        self._renew()
        numbers = self._numbers() | self._read_numbers
        settings = {"alpha": numbers["alpha"], "gamma": numbers["gamma"]}
        threads, losses = torch.get_num_threads(), []
        for run, (networks, own) in enumerate(zip(self._networks, self._gradients)):
            batch = Batch(*(x[run] for x in rows)) if self._one_by_one else Batch(*rows)
            if self.native:
                make = partial(NativeSAC, *networks, own, batch, log_scale_range=LOG_SCALE_RANGE, threads=threads)
                losses.append(self._prepared(run, make)(batch, **settings))
            else:
                gradients, found = self._find(*networks, batch, log_scale_range=LOG_SCALE_RANGE, **settings)
                torch._foreach_copy_(own, gradients)
                losses.append(found)
        self.optimiser.step()
        self._targets.lerp_(self._weights[-len(self._targets) :], numbers["tau"])
        return torch.stack(losses, -1).reshape(3, -1)

    def _numbers(self) -> dict[str, Any]:
        return {"alpha": self.loss.alpha, "gamma": self.loss.gamma, "tau": self.tau}

    def _renew(self) -> None:
        super()._renew()
        if self._read_targets.dtype != self._targets.dtype:
            self._read_targets.copy_(self._targets)

    def _buffers(self) -> dict[str, Tensor]:
        return super()._buffers() | {"targets": self._targets}

    def _cut_networks(self, *, one_by_one: bool) -> None:
        """Cut the flat buffers into networks for the products and into the gradients that Adam reads.

        Args:
            one_by_one: whether each run has networks of its own: a CPU multiplies the matrices of one network after the
                other. A GPU takes all runs in one product.
        """
        read, gradients = self._parts(self._read_weights), self._parts(self._gradient)
        targets = views(self._read_targets, read["qvalue"])
        runs: list[Any] = [()]  # where a network of one run, or of all of them, lies in stacked weights
        if self.num_runs is not None:
            runs = [(run,) for run in range(self.num_runs)] if one_by_one else [(slice(None),)]
        copies = range(self.qvalue.module.mlp.num_copies or 1)
        self._one_by_one = one_by_one
        self._networks = [
            (
                _network(read["policy"], run),
                [_network(read["qvalue"], (*run, n)) for n in copies],
                [_network(targets, (*run, n)) for n in copies],
            )
            for run in runs
        ]
        self._gradients = [
            [g[run] for g in gradients["policy"]] + [g[(*run, n)] for n in copies for g in gradients["qvalue"]]
            for run in runs
        ]

    def _noise(self, action: Tensor) -> Tensor:
        return torch.randn(action.shape, generator=self.rng, dtype=action.dtype, device=action.device)


def sac_gradients_in_order(
    policy: Network, critics: Sequence[Network], targets: Sequence[Network], batch: Batch, **settings: Any
) -> tuple[list[Tensor], Tensor]:
    """`sac_gradients` as a list, policy first; and actor loss, critic loss and entropy, ``[3, (K)]``."""
    found = sac_gradients(policy, critics, targets, batch, **settings)
    losses = torch.stack([found.loss_actor, found.loss_qvalue, found.entropy])
    return [*found.policy, *chain(*found.critics)], losses


def _network(layers: Sequence[Tensor], index: Any) -> Network:
    """One network, or one for each run, out of stacked weights and biases."""
    return Network([weight[index] for weight in layers[0::2]], [bias[index] for bias in layers[1::2]])
