"""The side of bodies and dream that TorchRL sees: each row has the design that was simulated, and its reward.

Shapes: ``*B`` batch of the environment, S observation, D design, A action.
"""

from __future__ import annotations

import math
from collections.abc import Callable, MutableMapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

RewardFn = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
# Rounding of a float32 design by a transform and its inverse.
RELATIVE_ROUNDING, ABSOLUTE_ROUNDING = 1e-4, 1e-5


class DesignedEnv(EnvBase):
    """An environment with a design that only a reset changes."""

    def reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        """Reset as TorchRL does; an empty tensordict keeps the designs, and is filled."""
        if tensordict is None or not tensordict.is_empty():
            return super().reset(tensordict, **kwargs)
        self._assert_tensordict_shape(tensordict)
        return tensordict.update(super().reset(**kwargs))


def idle_rows(tensordict: TensorDictBase, batch_size: torch.Size) -> Tensor | None:
    """Read which rows shall not be stepped, from TorchRL's entry ``_step``, which ``ConditionalSkip`` writes.

    Returns:
        ``[*B]`` bool; None if all rows are stepped.
    """
    stepped = tensordict.get("_step", None)
    return None if stepped is None else ~stepped.reshape(batch_size)


def leave_idle(after: MutableMapping[str, Tensor], before: TensorDictBase, idle: Tensor) -> None:
    """Correct the result for rows that were not stepped, in place: no reward, and the same flags as before.

    Args:
        after: result of a step, ``[*B]``.
        before: input of the step, ``[*B]``.
        idle: ``[*B]`` bool.
    """
    after["reward"] = torch.where(idle.unsqueeze(-1), 0, after["reward"])
    for key in ("done", "terminated", "truncated"):
        after[key][idle] = before[key][idle] if key in before else False


def check_step(given: Tensor | None, body: Tensor) -> None:
    """Refuse a step if its input has another design than the simulated bodies.

    The row would pair the design of one body with the motion of another.

    Args:
        given: ``design`` in the input of the step, or None if there is none.
        body: ``[*B, D]``, designs of the bodies.

    Raises:
        ValueError: if the two differ by more than the rounding of a transform and its inverse.
    """
    if given is None or given is body or torch.equal(given, body):
        return
    if given.shape == body.shape:
        close = torch.isclose(given.to(body.dtype), body, rtol=RELATIVE_ROUNDING, atol=ABSOLUTE_ROUNDING).all(-1)
        if close.all():
            return
        given, body = given[~close][0], body[~close][0]
    raise ValueError(
        f"the input of the step has the design {given.tolist()}, but the body is {body.tolist()}. Only a reset changes "
        "a body: give it the design. A TensorDictPrimer needs call_before_env_reset=True, and a transform of the "
        "design an out_key of its own, or in_keys_inv"
    )


def check_reset(given: TensorDictBase | None, readable: tuple[str, ...], design_shape: torch.Size) -> None:
    """Refuse a reset if a transform has renamed the design in its input.

    Otherwise, with a ``RenameTransform``, the bodies would silently not change.

    Args:
        given: input of the reset.
        readable: keys that the reset reads, besides ``_reset``.
        design_shape: ``[*B, D]``.

    Raises:
        ValueError: if none of the keys is present, and the input is empty or has another entry of a design's shape.
    """
    if given is None or any(key in given for key in ("_reset", *readable)):
        return
    strange = [str(key) for key, value in given.items() if value.shape == design_shape]
    if strange or given.is_empty():
        found = f"holds {strange[0]!r} and" if strange else "holds"
        raise ValueError(
            f"the tensordict of the reset {found} nothing named {' or '.join(map(repr, readable))}, which is all that "
            "this environment reads: call reset() without one to keep the bodies. Behind a RenameTransform give the "
            "design under the name that its inverse maps to 'design', and set transform.enable_inv_on_reset = True"
        )


def check_reward(reward: RewardFn, observation: Tensor, action: Tensor, design: Tensor, *, name: str) -> None:
    """Check what a reward function returns by calling it.

    Args:
        reward: ``(observation, action, next_observation, design) -> [*B, 1]``.
        observation: ``[*B, S]``, any values.
        action: ``[*B, A]``, any values.
        design: ``[*B, D]``, any values.
        name: name of the environment, for the message.

    Raises:
        ValueError: if it does not return ``[*B, 1]`` numbers in the observation's dtype.
    """
    # Rewards of a whole episode are computed at once, with one more batch dimension.
    here, torques, body = (value.expand(2, *value.shape) for value in (observation, action, design))
    found, wanted = reward(here, torques, here.clone(), body), [*here.shape[:-1], 1]
    if not isinstance(found, Tensor):
        raise ValueError(f"the reward of {name} is a {type(found).__name__}; return a tensor {wanted}")
    if list(found.shape) != wanted or found.dtype != here.dtype:
        raise ValueError(
            f"the reward of {name} has shape {list(found.shape)} and dtype {found.dtype} for observations "
            f"{list(here.shape)}, not {wanted} and {here.dtype}: it is [*B, 1], so keep the last axis, as in "
            "next_observation[..., 5, None]"
        )


def check_rewards(rewards: Tensor, design: Tensor, *, name: str) -> None:
    """Refuse what a reward function gave for steps that were simulated, if it is not finite.

    A learner would only find that its networks have diverged, and not why.

    Args:
        rewards: ``[*T, K, 1]``, of one step or of all steps of an episode.
        design: ``[K, D]``, the bodies.
        name: name of the environment, for the message.

    Raises:
        ValueError: that names the first such reward, its step and its body.
    """
    if math.isfinite(rewards.sum()):
        return
    if (broken := ~rewards.isfinite()).any():
        *step, row, _ = broken.nonzero()[0].tolist()
        when = f" at step {step[0]}" if step else ""
        raise ValueError(
            f"the reward of {name} is {rewards[broken][0].item()}{when} for the body {design[row].tolist()}, although "
            "all observations and actions are finite; give reward() a value for this state"
        )
