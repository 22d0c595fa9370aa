"""Set the simulator to any state and body, to compare a learnt model of the dynamics with it.

Shapes: N rows, S observation, D design, A action.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from coim.envs import MorphEnv
from coim.pairs import IN_THE_FLOOR


@dataclass(frozen=True)
class Truth:
    """Outcome of one step of the simulator.

    Attributes:
        next_observation: ``[N, S]``.
        depth: how far the lowest segment reached into the floor *before* the step, in m, ``[N]``.
        broken: whether the simulation broke in the step, ``[N]``; the next observation then means nothing.
    """

    next_observation: Tensor
    depth: Tensor
    broken: Tensor

    @property
    def impossible(self) -> Tensor:
        """States that no body can be in: more than `IN_THE_FLOOR` of it is below the floor, ``[N]``."""
        return self.depth > IN_THE_FLOOR


class PlacedSimulator:
    """Step the simulator from any pair of a state and a body.

    Args:
        body: class of the environment.
        size: simulations that are placed at once.
        num_threads: native threads that share them.

    Note:
        Root x, which most observations lack, is 0: nothing here depends on it.

    Example:
        >>> from coim import HopperMorph
        >>> simulator = PlacedSimulator(HopperMorph, size=2)
        >>> standing = torch.tensor([[1.25, *[0.0] * 10]]).expand(3, -1)
        >>> simulator.step(standing, torch.zeros(3, 3), torch.tensor([[1.0] * 4, [0.5] * 4, [2.0] * 4])).impossible
        tensor([False, False,  True])
    """

    def __init__(self, body: type[MorphEnv], *, size: int = 256, num_threads: int = 1) -> None:
        self.env = body(num_runs=size, num_threads=num_threads, seed=0)

    def step(self, observation: Tensor, action: Tensor, design: Tensor) -> Truth:
        """Place each row and take one step.

        Args:
            observation: ``[N, S]``.
            action: ``[N, A]``.
            design: ``[N, D]``, each within its bounds.
        """
        size = self.env.numel()
        parts = zip(*(x.split(size) for x in (observation, action, design)))
        steps = [self._step(*part) for part in parts]
        fields = (torch.cat(field).to(observation.device) for field in zip(*steps))
        return Truth(*fields)

    def _step(self, observation: Tensor, action: Tensor, design: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Step at most as many rows as there are simulations; spare simulations repeat the last row."""
        count = len(observation)
        rows = torch.arange(self.env.numel(), device=observation.device).clamp(max=count - 1)
        self.env.place(observation[rows], design[rows])
        depth = torch.stack([self._depth(row) for row in range(count)])
        following, _, broken = self.env.advance(action[rows])
        return following[:count].cpu(), depth, broken[:count, 0].cpu()

    def _depth(self, row: int) -> Tensor:
        moves = self.env.root.height is not None  # on a fixed base there is no floor to be in
        lowest = self.env.simulations.lowest_point(row) if moves else 0.0
        return torch.tensor(max(-lowest, 0.0), dtype=torch.float32, device="cpu")
