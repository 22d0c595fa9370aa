r"""Losses of policy and critics on real and imagined rows, Eq. 7-8; Eq. 3-4 when nothing is imagined.

`CoImSACLoss` defines what is learnt, and is the part to take for another pipeline. `coim.SACLearner` trains the
networks in Algorithm 1. It computes the same gradients by `coim.objectives.gradients`, which is written out for speed.
Two tests in ``tests/objectives/test_gradients.py`` hold them equal in float64:

- ``test_gradients_and_losses_equal_autograd``: every gradient to 1e-9 and every loss to 1e-10, relative; both values of
  ``mix``, with and without the run axis, one to three critics.
- ``test_twenty_updates_end_where_the_loss_adam_and_soft_update_end``: all weights and targets to 1e-9 after twenty
  updates of the learner, against this loss with Adam and SoftUpdate (in float32 to 1e-5, relative).

Shapes: ``B`` batch, ``K`` runs, ``N`` critics, ``A`` action, ``R`` rows.

References:
    Co-Imagination of Behaviour & Morphology of Agents, Eq. 3, 4, 7, 8.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictParams,
    dispatch,
)
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import TanhNormal
from torchrl.objectives import LossModule
from torchrl.objectives.sac import compute_rsample_log_prob

from .functional import bellman_target, mixing_weights, policy_loss, qvalue_loss, soft_value
from .moving import lent, move
from .runs import check_batch, check_by_row, check_num_runs, check_runs_last, split_runs


class CriticList(TensorDictModuleBase):
    """A list of single critics as one module: it joins their values, each ``[*B, 1]``, to ``[*B, N]``.

    Args:
        critics: TensorDict modules that all write ``key``.
        key: entry with the values.

    Raises:
        ValueError: if the list is empty, or has one critic twice.
    """

    def __init__(self, critics: Sequence[TensorDictModule], *, key: NestedKey = "state_action_value") -> None:
        super().__init__()
        if not critics or len({id(critic) for critic in critics}) < len(critics):
            raise ValueError(
                f"the list of {len(critics)} critics is empty or has one critic twice; make one module for each entry"
            )
        self.critics = nn.ModuleList(critics)
        self.in_keys = list(dict.fromkeys(k for critic in critics for k in critic.in_keys))
        self.out_keys = [key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the values of all critics."""
        values = [critic(tensordict.copy())[self.out_keys[0]] for critic in self.critics]
        return tensordict.set(self.out_keys[0], torch.cat(values, -1))


class CoImSACLoss(LossModule):
    r"""Soft actor-critic over real and imagined rows, Eq. 7-8.

    ``loss_qvalue`` is J_Q with the printed one half, summed over the critics; ``loss_actor`` is J_pi with the minimum
    of the critics.  Both are means over the batch (and sums over runs).  With ``mix="batch"`` and a fixed temperature
    they equal ``0.5 * SACLoss(loss_function="l2")`` and ``SACLoss`` of TorchRL.

    Target critics start equal to the critics and follow them by :class:`torchrl.objectives.SoftUpdate`.

    Args:
        policy: a TensorDict module that writes an action and has ``get_dist``.
        qvalue: one module that writes the values of all critics, ``[*B, (K,) N]``, or a list of single critics.
        alpha: entropy temperature (Sec. 6.1), fixed.
        gamma: discount.
        mix: ``"batch"`` takes one mean over real and imagined rows (Sec. 5), ``"sum"`` adds the mean over the imagined
            rows to the mean over the real ones (Eq. 7-8 as printed).
        num_runs: ``K``, the last batch dimension; None averages over the whole batch.
        reduction: ``"mean"`` as above; ``"sum"`` over all rows; ``"none"`` for one number per row, ``[*B, (K)]``.

    Raises:
        ValueError: if ``mix`` or ``reduction`` is unknown or they do not go together, a number is out of its range,
            ``num_runs`` is not that of the networks, or a list of critics is empty or has one of them twice.  When
            called: if values are not ``[*B, (K,) N]``, or log-densities not ``[*B, (K)]``.

    Note:
        Optional entries of a batch:

        - ``imagined``, bool ``[*B, 1]``; without it, all rows are real.
        - ``steps_to_next_obs``, ``[*B, 1]``, the number of steps to the next state, which TorchRL's
          ``MultiStepTransform`` writes; without it, 1.
        - ``priority_weight``, ``[*B, 1]``, the importance weights of TorchRL's prioritised replay: both losses become
          weighted means.
        - ``noise`` and ``("next", "noise")``, ``[*B, A]``, the :math:`\epsilon_t` of the actor's and of the target's
          action, for tests and common random numbers.

        For prioritised replay, the loss writes ``td_error`` into its input, as TorchRL's losses do: ``[*B, (K)]``, the
        largest absolute error of the critics. It changes nothing else.

    Example:
        >>> from coim.models import Policy, PolicyNetwork, QValue, QValueNetwork
        >>> from torchrl.objectives import SoftUpdate
        >>> policy, qvalue = Policy(PolicyNetwork(11, 4, 3)), QValue(QValueNetwork(11, 3, 4))
        >>> loss = CoImSACLoss(policy, qvalue, alpha=0.01, gamma=0.99)
        >>> targets = SoftUpdate(loss, tau=0.005)
        >>> step = {"observation": torch.zeros(256, 11), "design": torch.ones(256, 4)}
        >>> rows = TensorDict({**step, "action": torch.zeros(256, 3), "next": step}, [256])
        >>> rows["next", "reward"] = torch.ones(256, 1)
        >>> rows["next", "terminated"] = torch.zeros(256, 1, dtype=torch.bool)
        >>> out = loss(rows)
        >>> sorted(out.keys())
        ['entropy', 'loss_actor', 'loss_qvalue']
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` changes; those of the next step are read under ``"next"``.

        Attributes:
            action: stored action; the critics read the policy's action there too.
            design: taken from the current step if ``("next", design)`` is absent.
            state_action_value: output of the critics.
            reward: of the next step.
            terminated: of the next step; the only flag that stops the bootstrap.
            imagined: whether a row was imagined.
            noise: standard normal noise of the policy's action.
            steps_to_next_obs: number of steps to the next state.
            priority: output for prioritised replay.
            priority_weight: importance weight of a row.
        """

        action: NestedKey = "action"
        design: NestedKey = "design"
        state_action_value: NestedKey = "state_action_value"
        reward: NestedKey = "reward"
        terminated: NestedKey = "terminated"
        imagined: NestedKey = "imagined"
        noise: NestedKey = "noise"
        steps_to_next_obs: NestedKey = "steps_to_next_obs"
        priority: NestedKey = "td_error"
        priority_weight: NestedKey = "priority_weight"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    out_keys = ["loss_actor", "loss_qvalue", "entropy"]  # noqa: RUF012, TorchRL's convention

    policy: ProbabilisticTensorDictSequential
    policy_params: TensorDictParams
    target_policy_params: TensorDictParams
    qvalue: TensorDictModule
    qvalue_params: TensorDictParams
    target_qvalue_params: TensorDictParams

    def __init__(
        self,
        policy: ProbabilisticTensorDictSequential,
        qvalue: TensorDictModule | Sequence[TensorDictModule],
        *,
        alpha: float = 0.01,
        gamma: float = 0.99,
        mix: Literal["batch", "sum"] = "batch",
        num_runs: int | None = None,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        super().__init__()
        if mix not in ("batch", "sum"):
            raise ValueError(f"mix={mix!r} is unknown; choose 'batch' or 'sum'")
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f"reduction={reduction!r} is unknown; choose 'mean', 'sum' or 'none'")
        if mix == "sum" and reduction != "mean":
            raise ValueError(f"mix='sum' adds two means, and reduction={reduction!r} takes none; leave one of them out")
        if not 0 <= gamma <= 1:
            raise ValueError(f"gamma={gamma} is outside [0, 1]; Sec. 6.1 has 0.99")
        if not alpha >= 0:
            raise ValueError(f"alpha={alpha} is below 0; Sec. 6.1 has 0.01, 0 switches the entropy off")
        check_num_runs(num_runs, policy, *([qvalue] if isinstance(qvalue, nn.Module) else qvalue))
        if not isinstance(qvalue, nn.Module):
            qvalue = CriticList(qvalue)
        self.alpha, self.gamma, self.mix, self.num_runs = alpha, gamma, mix, num_runs
        self.reduction = reduction
        self.convert_to_functional(policy, "policy")
        self.convert_to_functional(qvalue, "qvalue", create_target_params=True)

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys that a batch must have: action, reward, terminated, and the networks' inputs, now and next."""
        keys = self.tensor_keys
        after = [*self.policy.in_keys, keys.reward, keys.terminated]
        now = [*self.policy.in_keys, *self.qvalue.in_keys, keys.action]
        return list(dict.fromkeys([*now, *(unravel_key(("next", key)) for key in after)]))

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        """Rename the output of a list of critics; this loss has no value estimator."""
        if isinstance(self.qvalue, CriticList):
            self.qvalue.out_keys = [self.tensor_keys.state_action_value]

    def _apply(self, fn: Callable[[Tensor], Tensor]) -> CoImSACLoss:
        """Move the loss, its networks and its targets to a device or dtype."""
        with move(fn, (self.policy, self.policy_params), (self.qvalue, self.qvalue_params)):
            super()._apply(fn)
        return self

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute both losses.

        Args:
            tensordict: ``[*B, (K)]`` transitions; ``td_error`` is written, nothing else is changed.

        Returns:
            ``loss_actor``, ``loss_qvalue`` and, for the log, ``entropy`` (nats): scalars, the entropy a mean over all
            rows, or with ``reduction="none"`` ``[*B, (K)]``.
        """
        check_batch(tensordict[self.tensor_keys.action].shape[:-1], self.num_runs)
        check_runs_last(tensordict, self.num_runs)
        # First the target's draw, then the actor's, as TorchRL does.
        loss_qvalue, td_error = self.qvalue_loss(tensordict)
        loss_actor, log_prob = self.actor_loss(tensordict)
        tensordict.set(self.tensor_keys.priority, td_error)
        by_row = self.reduction == "none"
        losses = {"loss_actor": loss_actor, "loss_qvalue": loss_qvalue}
        return TensorDict(
            {**losses, "entropy": -log_prob if by_row else -log_prob.mean()}, log_prob.shape if by_row else []
        )

    def qvalue_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """J_Q of Eq. 7, with a gradient for the critics only, and the error of each row, ``[*B, (K)]``."""
        tensordict = tensordict.detach()  # no gradient to the networks that made the rows
        target = self._td_target(tensordict)
        with lent(self.qvalue_params, self.qvalue):
            q = self._values(tensordict)
        td_error = (q.detach() - target.unsqueeze(-1)).abs().amax(-1)
        return self._reduced(qvalue_loss(q, target), tensordict), td_error

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """J_pi of Eq. 8, with a gradient for the policy only, and the log-densities, ``[*B, (K)]``."""
        tensordict = tensordict.detach()
        action, log_prob = self._act(tensordict)
        with lent(self.qvalue_params.data, self.qvalue):
            q = self._values(tensordict, action)
        loss = self._reduced(policy_loss(q, log_prob, self.alpha), tensordict)
        return loss, log_prob.detach()

    @torch.no_grad()
    def _td_target(self, tensordict: TensorDictBase) -> Tensor:
        after = tensordict["next"].copy()
        design = tensordict.get(self.tensor_keys.design, None)
        if design is not None and self.tensor_keys.design not in after.keys(True):
            after.set(self.tensor_keys.design, design)
        action, log_prob = self._act(after)
        with lent(self.target_qvalue_params, self.qvalue):
            value = soft_value(self._values(after, action), log_prob, self.alpha)
        reward, terminated = after[self.tensor_keys.reward], after[self.tensor_keys.terminated]
        reward, terminated = reward.reshape(value.shape), terminated.reshape(value.shape)
        steps = tensordict.get(self.tensor_keys.steps_to_next_obs, None)
        gamma = self.gamma if steps is None else self.gamma ** steps.reshape(reward.shape).to(reward.dtype)
        return bellman_target(reward, terminated, value, gamma)

    def _act(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        with (
            set_exploration_type(ExplorationType.RANDOM),
            lent(self.policy_params, self.policy),
        ):
            dist = self.policy.get_dist(tensordict.select(*self.policy.in_keys))
        noise = tensordict.get(self.tensor_keys.noise, None)
        action, log_prob = compute_rsample_log_prob(dist) if noise is None else reparametrised(dist, noise)
        check_by_row("the policy's log-densities", log_prob.shape, action.shape[:-1], "[*B]")
        return action, log_prob

    def _values(self, tensordict: TensorDictBase, action: Tensor | None = None) -> Tensor:
        if action is None:
            inputs = tensordict.select(*self.qvalue.in_keys)
        else:
            inputs = tensordict.select(*(key for key in self.qvalue.in_keys if key != self.tensor_keys.action))
            inputs.set(self.tensor_keys.action, action)
        batch = inputs[self.tensor_keys.action].shape[:-1]
        values = self.qvalue(inputs)[self.tensor_keys.state_action_value]
        check_by_row("the critics' values", values.shape[:-1], batch, "[*B, N], the critics last,")
        return values

    def _reduced(self, rows: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Reduce one number per row: by ``mix`` over the batch and a sum over runs, or by ``reduction``."""
        importance = tensordict.get(self.tensor_keys.priority_weight, None)
        if importance is not None:
            importance = importance.reshape(rows.shape)
        if self.reduction != "mean":
            rows = rows if importance is None else rows * importance.to(rows.dtype)
            return rows if self.reduction == "none" else rows.sum()
        imagined = tensordict.get(self.tensor_keys.imagined, None)
        imagined = torch.zeros_like(rows, dtype=torch.bool) if imagined is None else imagined.reshape(rows.shape).bool()
        importance = None if importance is None else split_runs(importance, self.num_runs)
        rows, imagined = split_runs(rows, self.num_runs), split_runs(imagined, self.num_runs)
        return (mixing_weights(imagined, self.mix, importance=importance, dtype=rows.dtype) * rows).sum()


def reparametrised(dist: Distribution, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Action and log-density of a policy for given noise, computed as in TanhNormal.rsample_and_log_prob.

    Args:
        dist: the policy's distribution.
        noise: standard normal, ``[*B, A]``.

    Returns:
        The action, ``[*B, A]``, and its log-density in nats, ``[*B]``.

    Raises:
        TypeError: if the distribution is not a TanhNormal.
    """
    if not isinstance(dist, TanhNormal):
        raise TypeError(f"noise is for TanhNormal policies, not {type(dist).__name__}; leave the key out to sample")
    preimage = dist.loc + noise * dist.scale
    transform = dist.transforms[0]
    action = transform(preimage)
    return action, dist.base_dist.log_prob(preimage) - transform.log_abs_det_jacobian(preimage, action).sum(-1)
