"""Learners: networks, loss, optimiser and target update as one thing that learns from batches.

`SACLearner` is one of the two model-free learners of Algorithm 1 (population or individual), `DynamicsLearner` the
Gaussian ensemble. Both take many batches in one call, ``[U, B]`` or ``[U, B, K]``: one optimiser step per leading row.

Shapes: U updates, B batch, K runs, A action.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Eq. 6-8, Algorithm 1 and Sec. 6.1.
"""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate

from coim.models.ensemble import GaussianEnsemble
from coim.models.policy import Policy
from coim.objectives.dynamics import EnsembleNLLLoss
from coim.objectives.sac import CoImSACLoss


class SACLearner:
    """Policy and critics that learn with Eq. 7-8, and with Eq. 3-4 where nothing in the batch is imagined.

    Args:
        policy: ``pi(a | s, xi)``.
        qvalue: the critics ``Q(s, a, xi)``.
        alpha: entropy temperature.
        gamma: discount.
        tau: share of the critics that moves into their targets after each update.
        lr: Adam's learning rate, the same for policy and critics.
        mix: how imagined rows enter the losses, see `coim.objectives.sac.CoImSACLoss`.
        num_runs: K when the networks are stacked along the run axis.
        seed: seeds the learner's own generator, from which every policy noise is drawn.

    Example:
        >>> import torch
        >>> from coim import HopperMorph, make_policy, make_qvalue
        >>> env = HopperMorph(num_runs=1, seed=0)
        >>> learner = SACLearner(make_policy(env, num_cells=(8,)), make_qvalue(env, num_cells=(8,)))
        >>> rows = env.rollout(6).reshape(3, 2)  # three updates with batches of two rows
        >>> sorted(learner.update(rows).keys())
        ['entropy', 'loss_actor', 'loss_qvalue']
    """

    def __init__(
        self,
        policy: Policy,
        qvalue: TensorDictModuleBase,
        *,
        alpha: float = 0.01,
        gamma: float = 0.99,
        tau: float = 0.005,
        lr: float = 3e-4,
        mix: Literal["batch", "sum"] = "batch",
        num_runs: int | None = None,
        seed: int = 0,
    ) -> None:
        self.policy = policy
        self.qvalue = qvalue
        self.loss = CoImSACLoss(policy, qvalue, alpha=alpha, gamma=gamma, mix=mix, num_runs=num_runs)
        self.targets = SoftUpdate(self.loss, tau=tau)
        self._parameters = [p for p in self.loss.parameters() if p.requires_grad]
        self._lr = lr
        self.optimiser = self._fresh_optimiser()
        self.rng = torch.Generator(self._parameters[0].device).manual_seed(seed)

    def _fresh_optimiser(self) -> torch.optim.Adam:
        return torch.optim.Adam(self._parameters, lr=self._lr, fused=True)

    def start_from(self, other: SACLearner) -> None:
        """Take the other learner's weights, targets included, with an optimiser that has seen nothing (Algorithm 1)."""
        self.loss.load_state_dict(other.loss.state_dict())
        self.optimiser = self._fresh_optimiser()

    def update(self, batches: TensorDictBase) -> TensorDict:
        """One optimiser step and one target update per batch.

        Args:
            batches: rows in the transition schema, ``[U, B]`` or ``[U, B, K]``; left untouched.

        Returns:
            The mean over the U updates of ``loss_actor``, ``loss_qvalue`` and ``entropy``.
        """
        batches = batches.copy()
        for key in ("noise", ("next", "noise")):
            batches.set(key, self._noise(batches["action"]))
        history = []
        for batch in batches.unbind(0):
            losses = self.loss(batch)
            self.optimiser.zero_grad(set_to_none=True)
            (losses["loss_actor"] + losses["loss_qvalue"]).backward()
            self.optimiser.step()
            self.targets.step()
            history.append(losses.detach())
        return torch.stack(history).mean(0)

    def _noise(self, action: Tensor) -> Tensor:
        return torch.randn(action.shape, generator=self.rng, dtype=action.dtype, device=action.device)


class DynamicsLearner:
    """The Gaussian ensemble learning Eq. 6 with Adam and weight decay (Sec. 6.1).

    Args:
        ensemble: the model; its normalisers are fed by `observe`.
        lr: learning rate.
        weight_decay: L2 penalty of Adam, as in the ensembles of PETS that the paper follows.
        num_runs: K when the ensemble is stacked along the run axis.
    """

    def __init__(
        self, ensemble: GaussianEnsemble, *, lr: float = 3e-4, weight_decay: float = 1e-5, num_runs: int | None = None
    ) -> None:
        self.ensemble = ensemble
        self.loss = EnsembleNLLLoss(ensemble, num_runs=num_runs)
        self._parameters: list[nn.Parameter] = [p for p in self.loss.parameters() if p.requires_grad]
        self.optimiser = torch.optim.Adam(self._parameters, lr=lr, weight_decay=weight_decay, fused=True)

    def observe(self, rows: TensorDictBase) -> None:
        """Count new rows of Replay_Pop in the running means and deviations that scale inputs and targets."""
        self.ensemble.update_statistics(rows)

    @torch.no_grad()
    def error(self, rows: TensorDictBase) -> Tensor:
        """Squared error of the members' means, in units of the variance of one-step changes in these rows.

        Args:
            rows: ``[R, K]``, at least two of them.

        Returns:
            Mean over rows, members and observation entries, ``[K]``; predicting "nothing changes" scores about 1.
        """
        observation, following = rows["observation"], rows["next", "observation"]
        means, _ = self.ensemble.moments(observation, rows["action"], rows["design"])
        error = self.ensemble.wrapped(means - following.unsqueeze(-2)).square().mean((0, -2))
        variance = self.ensemble.wrapped(following - observation).var(0)
        return (error / variance.clamp(min=1e-12)).mean(-1)

    def update(self, batches: TensorDictBase) -> TensorDict:
        """One optimiser step per batch of ``[U, B]`` or ``[U, B, K]`` rows; returns the mean ``loss_dynamics``."""
        history = []
        for batch in batches.unbind(0):
            losses = self.loss(batch)
            self.optimiser.zero_grad(set_to_none=True)
            losses["loss_dynamics"].backward()
            self.optimiser.step()
            history.append(losses.detach())
        return torch.stack(history).mean(0)
