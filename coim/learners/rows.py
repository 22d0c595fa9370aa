"""Rows in the transition schema: checked, and arranged as the bare tensors that the gradients are computed from.

Shapes: U updates, B batch, K runs, A action, F features.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from coim.models.scaling import InputScaling
from coim.objectives.dynamics import check_one_step
from coim.objectives.functional import mixing_weights
from coim.objectives.gradients import Batch
from coim.objectives.sac import CoImSACLoss


def on_device(rows: TensorDictBase, device: torch.device) -> TensorDictBase:
    """Move rows to where a learner is, unless they are there: a replay may stay on the CPU."""
    return rows if rows["observation"].device == device else rows.to(device)


def runs_first(x: Tensor, num_runs: int | None) -> Tensor:
    """Put the run axis before the batch, ``[U, B, (K), F] -> [U, K, B, F]``, with ``K = 1`` without a run axis."""
    return x.reshape(len(x), -1, num_runs or 1, x.shape[-1]).transpose(1, 2).contiguous()


def sac_batch(
    batches: TensorDictBase,
    noise: tuple[Tensor, Tensor],
    *,
    scaling: InputScaling | None,
    mix: Literal["batch", "sum"],
    num_runs: int | None,
) -> Batch:
    """Make the bare tensors of a SAC update.

    Args:
        batches: ``[U, B, K]`` in the transition schema.
        noise: standard normal numbers for the actions at both states, ``[U, B, K, A]`` each.
        scaling: how the networks scale their inputs, or None.
        mix: how imagined rows enter the losses; rows without ``imagined`` are real.
        num_runs: K, or None.

    Returns:
        Tensors ``[U, K, B, ...]``, with observations and designs as the networks' first layers see them.
    """
    after = batches["next"]
    imagined = batches.get("imagined", None)
    if imagined is None:
        imagined = torch.zeros_like(after["terminated"])

    def number(x: Tensor) -> Tensor:
        """Arrange one number per row, with a dimension of its own or without."""
        return runs_first(x.reshape(*batches.batch_size, 1), num_runs).squeeze(-1)

    def scaled(rows: TensorDictBase) -> tuple[Tensor, Tensor]:
        inputs = rows["observation"], batches["design"]
        observation, design = inputs if scaling is None else scaling(*inputs)
        return runs_first(observation, num_runs), runs_first(design, num_runs)

    weight = [mixing_weights(flag.mT, mix, dtype=noise[0].dtype).mT for flag in number(imagined)]
    observation, design = scaled(batches)
    return Batch(
        observation=observation,
        design=design,
        action=runs_first(batches["action"], num_runs),
        next_observation=scaled(after)[0],
        reward=number(after["reward"]),
        terminated=number(after["terminated"]),
        noise=runs_first(noise[0], num_runs),
        next_noise=runs_first(noise[1], num_runs),
        weight=torch.stack(weight),
    )


def check_sac_rows(rows: TensorDictBase, keys: CoImSACLoss._AcceptedKeys) -> None:
    """Refuse rows with an entry that `CoImSACLoss` takes into account and the gradients written out do not.

    Args:
        rows: ``[*B]`` in the transition schema.
        keys: entries that the loss reads.

    Raises:
        ValueError: if there is such an entry; the message has its key.
    """
    schema = asdict(CoImSACLoss.default_keys())
    renamed = {name: key for name, key in asdict(keys).items() if key != schema[name] and name != "priority"}
    if renamed:
        raise ValueError(f"SACLearner reads rows by the keys of the schema, not by {renamed}; rename their entries")
    check_one_step(rows, keys.steps_to_next_obs)
    if noise := [key for key in (keys.noise, ("next", keys.noise)) if key in rows.keys(True)]:
        raise ValueError(
            f"rows with {noise[0]!r}: SACLearner draws the policy's noise itself; train with CoImSACLoss, or exclude() "
            "the key"
        )
    after = ("next", keys.design)
    if after in rows.keys(True) and not torch.equal(rows[keys.design], rows[after]):
        raise ValueError(
            f"rows whose {after!r} is another design than {keys.design!r}: SACLearner asks the target about the body "
            "that acted; train with CoImSACLoss, or cut the rows where bodies change"
        )
    if keys.priority_weight in rows.keys(True):
        raise ValueError(
            f"rows with {keys.priority_weight!r}: SACLearner has no importance weights; train with CoImSACLoss, or "
            "exclude() the key to count all rows alike"
        )
