"""What world and dream share towards TorchRL: each row carries the body that was simulated, and its reward.

Shapes: ``*B`` batch of the environment, S observation, D design, A action.
"""

from __future__ import annotations

from collections.abc import Callable, MutableMapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

RewardFn = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
# What a transform and its inverse leave of a float32 design.
RELATIVE_ROUNDING, ABSOLUTE_ROUNDING = 1e-4, 1e-5


class DesignedEnv(EnvBase):
    """An environment with a design, which only a reset changes."""

    def reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        """TorchRL's reset; an empty tensordict asks for nothing, so that the designs stay, and is filled."""
        if tensordict is None or not tensordict.is_empty():
            return super().reset(tensordict, **kwargs)
        self._assert_tensordict_shape(tensordict)
        return tensordict.update(super().reset(**kwargs))


def idle_rows(tensordict: TensorDictBase, batch_size: torch.Size) -> Tensor | None:
    """Rows that TorchRL asks to leave as they are, by a ``_step`` in the input of a step, as ``ConditionalSkip`` does.

    Returns:
        ``[*B]`` bool; None where all rows are stepped.
    """
    stepped = tensordict.get("_step", None)
    return None if stepped is None else ~stepped.reshape(batch_size)


def leave_idle(after: MutableMapping[str, Tensor], before: TensorDictBase, idle: Tensor) -> None:
    """Answer for rows that were not stepped, in place: no reward, and the flags that they had.

    Args:
        after: answer of a step, ``[*B]``.
        before: input of the step, ``[*B]``.
        idle: ``[*B]`` bool.
    """
    after["reward"] = torch.where(idle.unsqueeze(-1), 0, after["reward"])
    for key in ("done", "terminated", "truncated"):
        after[key][idle] = before[key][idle] if key in before else False


def check_step(given: Tensor | None, body: Tensor) -> None:
    """Refuse a step whose input holds another design than that of the bodies that it moves.

    The row would pair the design of one body with the motion of another.

    Args:
        given: ``design`` in the input of the step, or None if there is none.
        body: ``[*B, D]``, the designs of the bodies.

    Raises:
        ValueError: they differ by more than the rounding of a transform and its inverse.
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
    """Refuse to reset from a tensordict whose design has lost its name on the way.

    Under a ``RenameTransform`` the bodies would stay as they are without a word.

    Args:
        given: what the reset is called with.
        readable: keys that it reads beside ``_reset``.
        design_shape: ``[*B, D]``.

    Raises:
        ValueError: none of the keys is there, and nothing is, or another entry of the shape of a design.
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
    """Try a reward function out.

    Args:
        reward: ``(observation, action, next_observation, design) -> [*B, 1]``.
        observation: ``[*B, S]``, any.
        action: ``[*B, A]``, any.
        design: ``[*B, D]``, any.
        name: of the environment, for the sentence.

    Raises:
        ValueError: it does not return ``[*B, 1]`` numbers of the observation's dtype.
    """
    # A whole episode is rewarded at once: one more batch dimension.
    here, torques, body = (value.expand(2, *value.shape) for value in (observation, action, design))
    found, wanted = reward(here, torques, here.clone(), body), [*here.shape[:-1], 1]
    if list(found.shape) != wanted or found.dtype != here.dtype:
        raise ValueError(
            f"the reward of {name} has shape {list(found.shape)} and dtype {found.dtype} for observations "
            f"{list(here.shape)}, not {wanted} and {here.dtype}: it is [*B, 1], so keep the last axis, as in "
            "next_observation[..., 5, None]"
        )
