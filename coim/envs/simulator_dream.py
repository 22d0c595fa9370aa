"""The simulator as h: a dream without model error.

Shapes: ``*B`` any batch, R rows of the fleet, S observation, A action, D design.

References:
    Co-Imagination of Behaviour & Morphology of Agents, Eq. 7 (h) and Sec. 6.4 (imagined designs that destroy learning).
"""

from __future__ import annotations

import torch
from torch import Tensor

from coim.envs.morph import MorphEnv


class SimulatorDynamics:
    """Next observations from the simulator, as a replacement for the ensemble in :class:`~coim.WorldModelEnv`.

    If learning fails with an ensemble but not with the simulator, the error of the model is the cause. If it fails with
    both, the cause is the queries, such as a state of one body with the design of another, or the bootstrap from there.

    Args:
        bodies: a separate fleet of R rows, which simulates R states and designs at a time. Its task and its reset noise
            do not matter.

    Note:
        A call does not depend on earlier calls. An observation does not have the solver's warm start and the root's x:
        the next observation of a stored state equals the stored one up to the precision of float32. A simulation that
        breaks keeps its observation, as in :class:`~coim.envs.morph.MorphEnv`.

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
            generator: not used; the simulator is deterministic.

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
        """Step several sets of (observation, action, design), as :meth:`sample` does: there is no randomness."""
        return tuple(self.sample(*one) for one in asked)


def _filled_up(rows: Tensor, count: int) -> Tensor:
    """Repeat the last row until there are as many rows as in the fleet."""
    missing = count - len(rows)
    return torch.cat([rows, rows[-1:].expand(missing, -1)]) if missing else rows
