"""The dynamics learner of Algorithm 1: ensemble, loss and optimiser as one thing.

`coim.objectives.EnsembleNLLLoss` says what is learnt. `coim.objectives.dynamics_gradients` computes its gradients
faster and is what trains; ``tests/objectives/test_dynamics_gradients.py`` holds the two equal.

Shapes: U updates, B batch, K runs, F input features, S state.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Eq. 6, Algorithm 1 and Sec. 6.1.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from coim.learners.flat_weights import FlatLearner, Precision
from coim.learners.known_networks import check_ensemble
from coim.learners.rows import on_device, runs_first
from coim.models.ensemble import LOG_VAR_RANGE, GaussianEnsemble
from coim.objectives.dynamics import EnsembleNLLLoss, check_one_step
from coim.objectives.dynamics_gradients import dynamics_gradients
from coim.objectives.gradients import Network
from coim.objectives.native_gradients import NativeDynamics, dynamics_updates
from coim.objectives.runs import by_update, check_batch, check_runs_last

STILL = 1e-6  # of an observation, if that is above 1: less than float32 tells apart, as in RunningNormaliser.std


class DynamicsLearner(FlatLearner):
    """The Gaussian ensemble, which learns Eq. 6 with Adam and weight decay (Sec. 6.1).

    Args:
        ensemble: the model, on its device and in its dtype already; its normalisers are fed by `observe`.
        lr: learning rate.
        weight_decay: L2 penalty of Adam, as in the ensembles of PETS that the paper follows.
        num_runs: K when the ensemble is stacked along the run axis.
        precision: ``"bfloat16"`` computes the network's products in bfloat16; weights, moments, targets and losses
            stay as they are.
        compile: compute the updates by compiled code, made in the first one; results differ by rounding. On a CPU that
            is native code, for weights of float32 or float64 and layers up to 512 units (256 with AVX-512 and on other
            processors); all else there is as without.

    Attributes:
        loss: the `EnsembleNLLLoss` over the same parameters, for those who want its value or its gradients.
        optimiser: Adam over the flat buffer of all weights. Its settings may be changed at any time; the next update
            follows.

    Raises:
        ValueError: if ``precision`` is unknown or ``num_runs`` is not the ensemble's.
        TypeError: if the ensemble computes anything else than a `coim.GaussianEnsemble`.

    Note:
        Moving the ensemble to another device or dtype afterwards parts it from the flat buffer, and so does a deep copy
        of the learner; `update` refuses that.

    Example:
        >>> from coim import HopperMorph
        >>> env = HopperMorph(num_runs=1, seed=0)
        >>> learner = DynamicsLearner(GaussianEnsemble.for_env(env, num_cells=(8,)))
        >>> rows = env.rollout(6)
        >>> learner.observe(rows)
        >>> learner.update(rows.reshape(3, 2))["loss_dynamics"].shape  # three updates with batches of two rows
        torch.Size([1])
    """

    def __init__(
        self,
        ensemble: GaussianEnsemble,
        *,
        lr: float = 3e-4,
        weight_decay: float = 1e-5,
        num_runs: int | None = None,
        precision: Precision = "float32",
        compile: bool = False,
    ) -> None:
        check_ensemble(ensemble)
        self.ensemble = ensemble
        self.loss = EnsembleNLLLoss(ensemble, num_runs=num_runs)
        networks = {"ensemble": ensemble.network}
        super().__init__(
            networks,
            dynamics_gradients,
            lr=lr,
            weight_decay=weight_decay,
            num_runs=num_runs,
            precision=precision,
            compile=compile,
            of_ensemble=True,
        )
        self._cut_networks()

    def observe(self, rows: TensorDictBase) -> None:
        """Add new rows of Replay_Pop to the running means and deviations that scale inputs and targets.

        Args:
            rows: ``[*B, (K)]`` on any device, each row once in its life.

        Raises:
            ValueError: if there are no rows, the run axis is missing or not the last, or a next observation is several
                steps ahead.
        """
        self.ensemble.update_statistics(self._taken(rows))

    def state_dict(self) -> dict[str, Any]:
        """Return what learning has changed: weights, moments, statistics. Tensors are not copied."""
        statistics = {"inputs": self.ensemble.inputs.state_dict(), "targets": self.ensemble.targets.state_dict()}
        return super().state_dict() | {name: dict(state) for name, state in statistics.items()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on as the learner that :meth:`state_dict` was read from; see `FlatLearner.load_state_dict`."""
        super().load_state_dict(state_dict)
        self.ensemble.inputs.load_state_dict(state_dict["inputs"])
        self.ensemble.targets.load_state_dict(state_dict["targets"])

    @torch.no_grad()
    def error(self, rows: TensorDictBase) -> Tensor:
        """Compute the squared error of the members' means, in variances of the one-step changes in these rows.

        Args:
            rows: ``[*B, (K)]`` on any device, at least two for each run.

        Returns:
            Mean over rows, members and the observation entries that change in these rows, ``[K]``; predicting "nothing
            changes" scores about 1. It is 0 where none of them changes.

        Raises:
            ValueError: as `observe` does.
        """
        rows = self._taken(rows).reshape(-1, self.num_runs or 1)
        observation, following = rows["observation"], rows["next", "observation"]
        means, _ = self.ensemble.moments(observation, rows["action"], rows["design"])
        error = self.ensemble.wrapped(means - following.unsqueeze(-2)).square().mean((0, -2))
        variance = self.ensemble.wrapped(following - observation).var(0, correction=0)
        # An entry that stands still, such as a target, has no unit: its variance is the rounding of floats.
        varied = variance.sqrt() > STILL * observation.abs().amax(0).clamp(min=1)
        return torch.where(varied, error / variance, 0).sum(-1) / varied.sum(-1).clamp(min=1)

    @torch.no_grad()
    def update(self, batches: TensorDictBase) -> TensorDict:
        """Do one optimiser step per batch.

        Args:
            batches: rows in the transition schema, on any device, shaped as for `coim.SACLearner.update`: ``[B, K]`` is
                one batch, ``[U, B, K]`` one for each of U updates; left untouched.

        Returns:
            ``loss_dynamics`` of each run, the sum over its members, ``[K]``: means over the U updates.

        Raises:
            ValueError: if the rows have another shape, there are none, or a next observation is several steps ahead.
            RuntimeError: if the ensemble was moved since the learner was made.
        """
        batches = by_update(batches, self.num_runs)
        self.check_networks_lie_here()
        mean = self._mean(self._arrange(self._taken(batches)))
        return TensorDict({"loss_dynamics": mean}, mean.shape)

    def _taken(self, rows: TensorDictBase) -> TensorDictBase:
        """Check that the ensemble can learn from these rows, and move them to its device."""
        check_batch(rows.batch_size, self.num_runs)
        check_runs_last(rows, self.num_runs)
        check_one_step(rows, self.loss.tensor_keys.steps_to_next_obs)
        return on_device(rows, self._weights.device)

    def _mean(self, batches: Iterable[Tensor]) -> Tensor:
        """As `FlatLearner._mean`, in one call for many updates where native code does all that an update does."""
        if not self._all_native():
            return super()._mean(batches)
        x, target = batches
        members, threads = self.ensemble.num_members, torch.get_num_threads()
        natives = [
            NativeDynamics(
                network,
                own,
                x[0, at // members],
                target[0, at // members],
                log_var_range=LOG_VAR_RANGE,
                threads=threads,
            )
            for at, (network, own) in enumerate(zip(self._networks, self._gradients))
        ]
        losses = self._natively(
            (x, target), len(natives), lambda part, step: dynamics_updates(natives, part[0], part[1], step)
        )
        return losses.unflatten(-1, (-1, members)).sum(-1).mean(0)

    def _update_once(self, *rows: Tensor) -> Tensor:
        """Do one update with inputs ``[K, B, F]`` and targets ``[K, B, S]``; return the losses, ``[K]``."""
        self._renew()
        losses = self._write_gradients(*rows)
        self.optimiser.step()
        return losses

    def _cut_networks(self) -> None:
        """Cut the flat buffers into networks for the products and into the gradients that Adam reads."""
        stack = len(self.ensemble.network.stack)
        read, gradients = (
            [part.flatten(0, stack - 1) for part in self._parts(flat)["ensemble"]]
            for flat in (self._read_weights, self._gradient)
        )
        # A CPU multiplies the matrices of one member after the other; a GPU takes all members in one product.
        in_one = self._read_weights.dtype == torch.float64 and not self.native
        self._stacked = self._weights.device.type != "cpu" or in_one
        members = [slice(None)] if self._stacked else range(len(read[0]))
        self._networks = [Network([w[m] for w in read[0::2]], [b[m] for b in read[1::2]]) for m in members]
        self._gradients = [[part[m] for part in gradients] for m in members]

    def _arrange(self, batches: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Standardised inputs ``[U, K, B, F]``, in the dtype of the products, and targets ``[U, K, B, S]``."""
        observation = batches["observation"]
        raw = torch.cat([observation, batches["action"], batches["design"]], -1)
        inputs = self.ensemble.inputs(raw).to(self._read_weights.dtype)
        targets = self.ensemble.standardised_target(observation, batches["next", "observation"])
        if self.native:
            targets = targets.to(self._weights.dtype)
        return runs_first(inputs, self.num_runs), runs_first(targets, self.num_runs)

    def _write_gradients(self, x: Tensor, target: Tensor) -> Tensor:
        """Write the gradients of ``[K, B, F]`` and ``[K, B, S]`` where Adam reads them; return the losses, ``[K]``."""
        members = self.ensemble.num_members
        if self._stacked:
            batches = [(x.repeat_interleave(members, 0), target.repeat_interleave(members, 0))]
        else:
            batches = [pair for pair in zip(x, target) for _ in range(members)]
        threads, losses = torch.get_num_threads(), []
        for member, (network, own, batch) in enumerate(zip(self._networks, self._gradients, batches)):
            if self.native:
                make = partial(NativeDynamics, network, own, *batch, log_var_range=LOG_VAR_RANGE, threads=threads)
                losses.append(self._prepared(member, make)(*batch))
            else:
                gradients, loss = self._find(network, *batch, log_var_range=LOG_VAR_RANGE)
                torch._foreach_copy_(own, gradients)
                losses.append(loss)
        return torch.stack(losses).reshape(-1, members).sum(-1)
