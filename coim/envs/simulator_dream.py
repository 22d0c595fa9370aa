"""The simulator itself as h: a dream without any error of a model.

Shapes: ``*B`` any batch, R rows of the fleet, S observation, A action, D design.

References:
    Co-Imagination of Behaviour & Morphology of Agents, Eq. 7 (h) and Sec. 6.4 (imagined designs that destroy learning).
"""

from __future__ import annotations

import torch
from torch import Tensor

from coim.envs.morph import MorphEnv


class SimulatorDynamics:
    """Next observations from the true physics, in the place of an ensemble in :class:`~coim.WorldModelEnv`.

    What goes wrong with an ensemble and not with this one is the model's error; what goes wrong with both is due to
    what is asked of it, such as a state of one body under the design of another, and to the bootstrapping from there.

    Args:
        bodies: a fleet of its own, R rows, that is set to the states and designs asked for, R at a time. Its task and
            its reset noise do not matter.

    Note:
        Nothing is carried from one call to the next. The solver's warm start and the root's x are no part of an
        observation: a state that was once seen goes on as it did to the precision of float32. A simulation that breaks
        stays where it was, as in :class:`~coim.envs.morph.MorphEnv`.

    Example:
        >>> from coim import HopperMorph, WorldModelEnv
        >>> env = HopperMorph(seed=0)
        >>> dream = WorldModelEnv(SimulatorDynamics(HopperMorph(num_runs=4)), env, batch_size=[10])
        >>> observation, action, design = torch.zeros(10, 11), torch.zeros(10, 3), torch.ones(10, 4)
        >>> observation[:, 0] = 1.25  # m: it stands
        >>> next_observation, reward = dream.advance(observation, action, design)
        >>> next_observation.shape, reward.shape
        (torch.Size([10, 11]), torch.Size([10, 1]))
    """

    def __init__(self, bodies: MorphEnv) -> None:
        self.bodies = bodies

    @torch.no_grad()
    def sample(
        self, observation: Tensor, action: Tensor, design: Tensor, *, generator: torch.Generator | None = None
    ) -> Tensor:
        """Step each state with its action and its body.

        Args:
            observation: ``[*B, S]``.
            action: ``[*B, A]``, in [-1, 1].
            design: ``[*B, D]``.
            generator: not used, the physics draw nothing.

        Returns:
            Next observations ``[*B, S]`` without gradients.

        Raises:
            ValueError: if a number is not finite, or a design leaves the bounds.
        """
        rows = self.bodies.numel()
        asked = [value.reshape(-1, value.shape[-1]) for value in (observation, action, design)]
        after = torch.empty_like(asked[0])
        for start in range(0, len(after), rows):
            part = slice(start, start + rows)
            here, torques, body = (_filled_up(value[part], rows) for value in asked)
            self.bodies.place(here, body)
            found = self.bodies.move(torques)[0]
            after[part] = found[: len(after[part])]
        return after.reshape(observation.shape)

    def means(
        self, *asked: tuple[Tensor, Tensor, Tensor], generator: torch.Generator | None = None
    ) -> tuple[Tensor, ...]:
        """Step several sets of (observation, action, design), as :meth:`sample` does: the physics have no spread."""
        return tuple(self.sample(*one) for one in asked)


def _filled_up(rows: Tensor, count: int) -> Tensor:
    """The last row repeated until there are as many as the fleet has."""
    missing = count - len(rows)
    return torch.cat([rows, rows[-1:].expand(missing, -1)]) if missing else rows
