"""The dynamics learner of Algorithm 1: ensemble, loss and optimiser as one thing.

`coim.objectives.EnsembleNLLLoss` says what is learnt; `coim.objectives.dynamics_gradients` computes its gradients
faster. All weights lie in one flat buffer, of which the ensemble's parameters are views.

Shapes: U updates, B batch, K runs, E members, F input features, S state, R rows.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Eq. 6, Algorithm 1 and Sec. 6.1.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from coim.compiling import compiled
from coim.learners.flat_weights import (
    FlatUpdates,
    Precision,
    by_run,
    check_sizes,
    load_moments,
    moments_by_run,
    on_device,
    share_storage,
    views,
)
from coim.learners.written_out import check_ensemble
from coim.models.ensemble import LOG_VAR_RANGE, GaussianEnsemble
from coim.objectives.dynamics import EnsembleNLLLoss, check_one_step
from coim.objectives.dynamics_gradients import dynamics_gradients
from coim.objectives.gradients import Network
from coim.objectives.runs import by_update, check_batch, check_runs_last


class DynamicsLearner:
    """The Gaussian ensemble learning Eq. 6 with Adam and weight decay (Sec. 6.1).

    Args:
        ensemble: the model, on its device and in its dtype already; its normalisers are fed by `observe`.
        lr: learning rate.
        weight_decay: L2 penalty of Adam, as in the ensembles of PETS that the paper follows.
        num_runs: K when the ensemble is stacked along the run axis.
        precision: ``"bfloat16"`` takes the network's products in bfloat16; weights, moments, targets and losses stay as
            they are.
        compile: compile the gradients by `torch.compile` in the first update; results differ by rounding.

    Attributes:
        loss: the `EnsembleNLLLoss` over the same parameters, for those who want its value or its gradients.
        optimiser: Adam over the flat buffer of all weights.  Its settings may be changed at any time; the next update
            follows.

    Raises:
        ValueError: if ``precision`` is unknown or ``num_runs`` is not the ensemble's.
        TypeError: if the ensemble computes anything else than a `coim.GaussianEnsemble`.

    Note:
        Moving the ensemble to another device or dtype afterwards parts it from the flat buffer; so does a deep copy of
        the learner.

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
        if precision not in ("float32", "bfloat16"):
            raise ValueError(f"precision={precision!r} is unknown; choose 'float32' or 'bfloat16'")
        check_ensemble(ensemble)
        self.ensemble, self.num_runs = ensemble, num_runs
        self.loss = EnsembleNLLLoss(ensemble, num_runs=num_runs)
        self._lay_out(list(ensemble.network.parameters()), precision)
        self._find = compiled(dynamics_gradients, self._weights.device) if compile else dynamics_gradients
        self._updates = FlatUpdates(self._update_once, self._weights, lr=lr, weight_decay=weight_decay)
        self.optimiser = self._updates.optimiser

    def observe(self, rows: TensorDictBase) -> None:
        """Count new rows of Replay_Pop in the running means and deviations that scale inputs and targets.

        Args:
            rows: ``[*B, (K)]`` on any device, each row once in its life.

        Raises:
            ValueError: if there are no rows, the run axis is missing or not the last, or a next observation is several
                steps ahead.
        """
        self.ensemble.update_statistics(self._taken(rows))

    def state_dict(self) -> dict[str, Any]:
        """Return what learning has changed: weights, moments, statistics. Tensors are not copied."""
        return {
            "weights": self._weights.detach(),
            "moments": dict(self.optimiser.state.get(self._weights, {})),
            "inputs": dict(self.ensemble.inputs.state_dict()),
            "targets": dict(self.ensemble.targets.state_dict()),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on as the learner that :meth:`state_dict` was read from.

        Raises:
            ValueError: if that one's ensemble has other sizes; nothing is changed then.
        """
        weights = self._weights.detach()
        check_sizes({"weights": weights}, state_dict)
        weights.copy_(state_dict["weights"])
        load_moments(self.optimiser, self._weights, state_dict["moments"])
        self.ensemble.inputs.load_state_dict(state_dict["inputs"])
        self.ensemble.targets.load_state_dict(state_dict["targets"])

    def weights_by_run(self) -> list[Tensor]:
        """Weights with the run axis first, ``[K, ...]``: views, not copies."""
        return by_run(self._weights, [*self.ensemble.network.parameters()], self.num_runs)

    def moments_by_run(self) -> list[Tensor]:
        """Adam's moments, as `weights_by_run` has the weights; none before its first step."""
        parameters = [*self.ensemble.network.parameters()]
        return moments_by_run(self.optimiser, self._weights, parameters, self.num_runs)

    def check_networks_lie_here(self) -> None:
        """Refuse to go on with an ensemble that was moved, or given to another learner, after this one was made.

        Raises:
            RuntimeError: if the ensemble's weights no longer lie in the flat buffer.
        """
        if next(self.ensemble.network.parameters()).data_ptr() != self._weights.data_ptr():
            raise RuntimeError("the ensemble was moved after its learner was made; make the learner last")

    @torch.no_grad()
    def error(self, rows: TensorDictBase) -> Tensor:
        """Squared error of the members' means, in units of the variance of one-step changes in these rows.

        Args:
            rows: ``[*B, (K)]`` on any device, at least two for each run.

        Returns:
            Mean over rows, members and observation entries, ``[K]``; predicting "nothing changes" scores about 1.

        Raises:
            ValueError: as `observe` does.
        """
        rows = self._taken(rows).reshape(-1, self.num_runs or 1)
        observation, following = rows["observation"], rows["next", "observation"]
        means, _ = self.ensemble.moments(observation, rows["action"], rows["design"])
        error = self.ensemble.wrapped(means - following.unsqueeze(-2)).square().mean((0, -2))
        variance = self.ensemble.wrapped(following - observation).var(0, correction=0)
        return (error / variance.clamp(min=1e-12)).mean(-1)

    @torch.no_grad()
    def update(self, batches: TensorDictBase) -> TensorDict:
        """One optimiser step per batch.

        Args:
            batches: rows in the transition schema, on any device, shaped as for `coim.SACLearner.update`: ``[B, K]`` is
                one batch, ``[U, B, K]`` one for each of U updates; left untouched.

        Returns:
            ``loss_dynamics`` of each run, the sum over its members, ``[K]``: means over the U updates.

        Raises:
            ValueError: if the rows have another shape, there are none, or a next observation is several steps ahead.
            RuntimeError: if the ensemble's weights no longer lie in the flat buffer.
        """
        batches = by_update(batches, self.num_runs)
        self.check_networks_lie_here()
        mean = self._updates.mean(zip(*self._arrange(self._taken(batches))))
        return TensorDict({"loss_dynamics": mean}, mean.shape)

    def _taken(self, rows: TensorDictBase) -> TensorDictBase:
        """Rows on the device of the ensemble, after they were found to be what it learns from."""
        check_batch(rows.batch_size, self.num_runs)
        check_runs_last(rows, self.num_runs)
        check_one_step(rows, self.loss.tensor_keys.steps_to_next_obs)
        return on_device(rows, self._weights.device)

    def _update_once(self, x: Tensor, target: Tensor) -> Tensor:
        """One update with a batch, ``[K, B, F]`` and ``[K, B, S]``; its losses, ``[K]``."""
        if self._read_weights.dtype != self._weights.dtype:
            self._read_weights.copy_(self._weights)
        losses = self._write_gradients(x, target)
        self.optimiser.step()
        return losses

    def _lay_out(self, parameters: list[nn.Parameter], precision: Precision) -> None:
        """Move all weights into one flat buffer, and cut it and that of the gradients into networks."""
        self._weights = nn.Parameter(share_storage(parameters))
        self._weights.grad = torch.zeros_like(self._weights.detach())
        # Products read these: the weights themselves, or a copy in bfloat16 that every update renews.
        self._read_weights = self._weights.detach()
        if precision == "bfloat16":
            self._read_weights = self._read_weights.to(torch.bfloat16)
        stack = len(self.ensemble.network.stack)
        read, gradients = (
            [part.flatten(0, stack - 1) for part in views(flat, parameters)]
            for flat in (self._read_weights, self._weights.grad)
        )
        # A CPU multiplies the matrices of one member after the other; a GPU wants all in one product.
        self._stacked = self._weights.device.type != "cpu" or self._read_weights.dtype == torch.float64
        members = [slice(None)] if self._stacked else range(len(read[0]))
        self._networks = [Network([w[m] for w in read[0::2]], [b[m] for b in read[1::2]]) for m in members]
        self._gradients = [[part[m] for part in gradients] for m in members]

    def _arrange(self, batches: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Standardised inputs ``[U, K, B, F]``, in the dtype of the products, and targets ``[U, K, B, S]``."""
        observation, runs = batches["observation"], self.num_runs or 1
        raw = torch.cat([observation, batches["action"], batches["design"]], -1)
        inputs = self.ensemble.inputs(raw).to(self._read_weights.dtype)
        targets = self.ensemble.standardised_target(observation, batches["next", "observation"])
        found = (x.reshape(len(x), -1, runs, x.shape[-1]).transpose(1, 2).contiguous() for x in (inputs, targets))
        return next(found), next(found)

    def _write_gradients(self, x: Tensor, target: Tensor) -> Tensor:
        """Write the gradients of ``[K, B, F]`` and ``[K, B, S]`` where Adam reads them; returns the losses, ``[K]``."""
        members = self.ensemble.num_members
        if self._stacked:
            batches = [(x.repeat_interleave(members, 0), target.repeat_interleave(members, 0))]
        else:
            batches = [pair for pair in zip(x, target) for _ in range(members)]
        losses = []
        for network, own, batch in zip(self._networks, self._gradients, batches):
            gradients, loss = self._find(network, *batch, log_var_range=LOG_VAR_RANGE)
            torch._foreach_copy_(own, gradients)
            losses.append(loss)
        return torch.stack(losses).reshape(-1, members).sum(-1)
