r"""Loss of the dynamics ensemble, Eq. 6.

Shapes: ``B`` batch, ``K`` runs, ``E`` members, ``S`` state.

References:
    Co-Imagination of Behaviour & Morphology of Agents, Eq. 6.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase, TensorDictParams, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule

from .functional import gaussian_nll
from .moving import lent, move
from .runs import check_batch, check_by_row, check_num_runs, check_runs_last, split_runs


class EnsembleNLLLoss(LossModule):
    """Negative log-likelihood of the transitions under each member of the ensemble, J_p of Eq. 6.

    ``loss_dynamics`` is the mean over the batch and the sum over members (and runs): each member gets the same gradient
    as when it is trained alone.  The loss compares standardised targets, which shifts Eq. 6 by a constant and gives all
    entries of the observation the same weight.

    Args:
        ensemble: a :class:`~coim.models.GaussianEnsemble`, or any TensorDict module that writes ``mean`` and
            ``log_var``, ``[*B, (K,) E, S]``, and has ``standardised_target(observation, next_observation)``.
        num_runs: ``K``, the last batch dimension; None averages over the whole batch.

    Raises:
        ValueError: if ``num_runs`` is not that of the ensemble.  When called: if a next observation is more than one
            step ahead (``steps_to_next_obs``), or means are not ``[*B, (K,) E, S]``.

    Note:
        All members learn from the same rows, and differ only by their initial weights.  Chua et al. [3] draw a
        bootstrap of the data for each member.

    Example:
        >>> import torch
        >>> from coim.models import GaussianEnsemble
        >>> loss = EnsembleNLLLoss(GaussianEnsemble(11, 3, 4, num_cells=(8, 8)))
        >>> rows = TensorDict({"observation": torch.zeros(256, 11), "action": torch.zeros(256, 3)}, [256])
        >>> rows["design"], rows["next", "observation"] = torch.ones(256, 4), torch.ones(256, 11)
        >>> loss(rows)["loss_dynamics"].shape
        torch.Size([])
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` changes.

        Attributes:
            observation: state; the next one is read at ``("next", observation)``.
            mean: output of the ensemble.
            log_var: output of the ensemble.
            steps_to_next_obs: number of steps to the next observation; 1 if absent.
        """

        observation: NestedKey = "observation"
        mean: NestedKey = "mean"
        log_var: NestedKey = "log_var"
        steps_to_next_obs: NestedKey = "steps_to_next_obs"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    out_keys = ["loss_dynamics"]  # noqa: RUF012, TorchRL's convention

    ensemble: TensorDictModuleBase
    ensemble_params: TensorDictParams
    target_ensemble_params: TensorDictParams

    def __init__(self, ensemble: TensorDictModuleBase, *, num_runs: int | None = None) -> None:
        super().__init__()
        check_num_runs(num_runs, ensemble)
        self.num_runs = num_runs
        self.convert_to_functional(ensemble, "ensemble")

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys that the loss reads: the inputs of the ensemble and the next observation."""
        return [*self.ensemble.in_keys, unravel_key(("next", self.tensor_keys.observation))]

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        """Do nothing: this loss has no value estimator."""

    def _apply(self, fn: Callable[[Tensor], Tensor]) -> EnsembleNLLLoss:
        """Move the loss and the ensemble to a device or dtype; both keep the same running statistics."""
        with move(fn, (self.ensemble, self.ensemble_params)):
            super()._apply(fn)
        return self

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss.

        Args:
            tensordict: ``[*B, (K)]`` rows of Replay_Pop; not changed.

        Returns:
            A TensorDict with the scalar ``loss_dynamics``; its gradient goes to the ensemble only.
        """
        tensordict = tensordict.detach()
        check_one_step(tensordict, self.tensor_keys.steps_to_next_obs)
        observation = tensordict[self.tensor_keys.observation]
        check_batch(observation.shape[:-1], self.num_runs)
        check_runs_last(tensordict, self.num_runs)
        next_observation = tensordict[unravel_key(("next", self.tensor_keys.observation))]
        with lent(self.ensemble_params, self.ensemble):
            out = self.ensemble(tensordict.select(*self.ensemble.in_keys))
            target = self.ensemble.standardised_target(observation, next_observation)
        mean, log_var = out[self.tensor_keys.mean], out[self.tensor_keys.log_var]
        check_by_row("the members' means", mean.shape[:-2], observation.shape[:-1], "[*B, E, S]")
        nll = gaussian_nll(mean, log_var, target.unsqueeze(-2)).sum(-1)  # members
        return TensorDict({"loss_dynamics": split_runs(nll, self.num_runs).mean(0).sum()})


def check_one_step(rows: TensorDictBase, key: NestedKey) -> None:
    """Refuse rows with a next observation that is more than one step ahead.

    Args:
        rows: ``[*B]``.
        key: entry with the number of steps; without it, every row is one step.

    Raises:
        ValueError: if a row has more than one step; the message has the largest number.
    """
    steps = rows.get(key, None)
    if steps is not None and bool((steps != 1).any()):
        raise ValueError(
            f"{key!r} is up to {int(steps.max())}, 1 is needed here: train on rows of single steps, "
            "without MultiStepTransform (CoImSACLoss takes n-step rows)"
        )
