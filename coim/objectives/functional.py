r"""Every equation of the paper, one pure function each.

Shapes: ``B`` any batch, ``R`` rows, ``K`` runs, ``N`` critics, ``A`` action, ``S`` state, ``n`` start states.

References:
    Co-Imagination of Behaviour & Morphology of Agents, Eq. 3 to 8.
    Haarnoja et al. 2018, Soft Actor-Critic (arXiv:1801.01290), [9] of the paper, Appendix C: density under the tanh.
    Chua et al. 2018, Deep Reinforcement Learning in a Handful of Trials (arXiv:1805.12114), [3] of the paper.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import softplus


def soft_value(q: Tensor, log_prob: Tensor, alpha: float | Tensor) -> Tensor:
    r"""State value under the target critics, :math:`V_{\bar\theta}` of Eq. 3.

    Args:
        q: critics at a fresh policy action, ``[*B, N]``.
        log_prob: log-density of that action in nats, ``[*B]``.
        alpha: entropy temperature.

    Returns:
        ``min_n q_n - alpha * log_prob``, ``[*B]``.
    """
    return q.amin(-1) - alpha * log_prob


def bellman_target(reward: Tensor, terminated: Tensor, value: Tensor, gamma: float | Tensor) -> Tensor:
    r"""Target of the critics, :math:`r + \gamma V_{\bar\theta}(s_{t+1}, \xi)` of Eq. 3.

    Args:
        reward: ``[*B]``.
        terminated: bool, ``[*B]``.  Only these rows have no future value; a time limit does not set it.
        value: of the next state, ``[*B]``.
        gamma: discount, in [0, 1].  Where the next state is n steps ahead, its n-th power, ``[*B]``.

    Returns:
        ``[*B]``.
    """
    return reward + gamma * torch.where(terminated, 0.0, value)


def qvalue_loss(q: Tensor, target: Tensor) -> Tensor:
    """One row of J_Q, Eq. 3 with the printed one half, summed over the critics.

    Args:
        q: critics at the stored action, ``[*B, N]``.
        target: :func:`bellman_target`, ``[*B]``; the same for all critics.

    Returns:
        ``sum_n (q_n - target)^2 / 2``, ``[*B]``.
    """
    return (q - target.unsqueeze(-1)).square().sum(-1) / 2


def policy_loss(q: Tensor, log_prob: Tensor, alpha: float | Tensor) -> Tensor:
    """One row of J_pi, Eq. 4, with the minimum of the critics as Q.

    Args:
        q: critics at a reparametrised policy action, ``[*B, N]``.
        log_prob: log-density of that action in nats, ``[*B]``.
        alpha: entropy temperature.

    Returns:
        ``alpha * log_prob - min_n q_n``, ``[*B]``.
    """
    return alpha * log_prob - q.amin(-1)


def tanh_normal(loc: Tensor, scale: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    r"""Reparametrised action :math:`f_\phi(\epsilon_t; s_t, \xi)` of Eq. 4 and its log-density.

    Args:
        loc: mean before the tanh, ``[*B, A]``.
        scale: standard deviation before the tanh, ``[*B, A]``.
        noise: :math:`\epsilon_t`, standard normal, ``[*B, A]``.

    Returns:
        The action, ``[*B, A]`` in [-1, 1], and its log-density in nats, ``[*B]``.

    Note:
        The density is taken at the value before the tanh, which stays exact where the tanh saturates.
    """
    preimage = loc + scale * noise
    log_normal = -noise.square() / 2 - scale.log() - math.log(2 * math.pi) / 2
    log_slope = 2 * (math.log(2) - preimage - softplus(-2 * preimage))  # log(1 - tanh(preimage)^2)
    return preimage.tanh(), (log_normal - log_slope).sum(-1)


def mixing_weights(
    imagined: Tensor,
    mix: Literal["batch", "sum"],
    *,
    importance: Tensor | None = None,
    dtype: torch.dtype | None = None,
) -> Tensor:
    r"""Weight of each row in Eq. 7-8: their expectations are ``(weights * rows).sum(0)``.

    ``"batch"`` is the mixture of Sec. 5, one mean over real and imagined rows; ``"sum"`` is the printed sum of two
    expectations, the mean over the real rows plus the mean over the imagined ones.

    Args:
        imagined: bool, ``[R, K]``; each run's own rows are in its column.
        mix: ``"batch"`` or ``"sum"``.
        importance: weight of each row within its mean, in any unit, ``[R, K]``; None weighs all rows alike.
        dtype: of the result, torch's default if None.

    Returns:
        ``[R, K]``. A run without rows of one kind, or whose rows of it all weigh nothing, gets nothing from that kind.
    """
    if importance is not None:
        importance = importance.to(dtype or torch.get_default_dtype())
        whole = importance.sum(0)
        if mix == "sum":
            whole = torch.where(imagined, (importance * imagined).sum(0), (importance * ~imagined).sum(0))
        return torch.where(whole > 0, importance / whole, 0)
    if mix == "batch":
        return torch.full(imagined.shape, 1 / imagined.shape[0], dtype=dtype, device=imagined.device)
    num_imagined = imagined.sum(0)
    num_real = imagined.shape[0] - num_imagined
    return torch.where(imagined, num_imagined, num_real).to(dtype or torch.get_default_dtype()).reciprocal()


def gaussian_nll(mean: Tensor, log_var: Tensor, target: Tensor) -> Tensor:
    r"""One row of Eq. 6, for a diagonal :math:`\Sigma`, as printed.

    Args:
        mean: ``[*B, S]``.
        log_var: logarithm of the diagonal of :math:`\Sigma`, ``[*B, S]``.
        target: ``[*B, S]``.

    Returns:
        ``sum_S (mean - target)^2 / var + log_var``, ``[*B]``.

    Note:
        That is twice the negative log-density without its constant ``S log(2 pi)``.
    """
    return ((mean - target).square() * (-log_var).exp() + log_var).sum(-1)


def design_value(q: Tensor) -> Tensor:
    """Fitness of designs, Eq. 5: the mean over start states of the minimum of the critics.

    Args:
        q: critics at the deterministic action from each start state, ``[*B, n, N]``.

    Returns:
        ``[*B]``.
    """
    return q.amin(-1).mean(-1)
