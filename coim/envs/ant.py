"""Ant with legs of variable length: a robot that moves freely through space.

The paper has no ant; this one shows that nothing here is for planar robots alone.

Shapes: *B any batch, S = 27 observation, D = 8 design, A = 8 action.

References:
    Schulman et al.: High-dimensional continuous control using generalized advantage estimation, ICLR 2016 (the body).
    Gymnasium's Ant-v5, https://gymnasium.farama.org/environments/mujoco/ant (its numbers).
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from coim.envs.morph import MorphEnv
from coim.envs.robot import uniform_and_normal
from coim.envs.task import Task, speed_along

HEIGHT, FORWARD_VELOCITY = 0, 13  # entries of the observation
LEGS = ("front left", "back left", "back right", "front right")  # in the order of the file


class AntMorph(MorphEnv):
    """Four-legged ant whose eight leg segments are the design.

    ==========  ========================================================  =========  ===========
    design      segment                                                   at xi = 1  range of xi
    ==========  ========================================================  =========  ===========
    0, 2, 4, 6  thigh: front left, back left, back right, front right     0.283 m    0.5 - 1.5
    1, 3, 5, 7  shin: front left, back left, back right, front right      0.566 m    0.5 - 1.5
    ==========  ========================================================  =========  ===========

    ===========  ============================================================  ============
    observation  quantity                                                      unit
    ===========  ============================================================  ============
    0            height of the torso's centre above the floor                  m
    1 - 4        orientation of the torso, a unit quaternion (w, x, y, z)      1
    5 - 12       hip and ankle of each leg, in the order of the design         rad
    13 - 15      velocity of the torso along x, y, z of the world              m/s
    16 - 18      angular velocity of the torso about its own axes              rad/s
    19 - 26      angular velocities of the joints, in the order above          rad/s
    ===========  ============================================================  ============

    The eight actions are the torques of hip and ankle, first of the front right leg, then of the others in the order of
    the design, as shares of 150 N m (Gymnasium's order). A step takes 0.05 s.

    Reward: ``dx + (0.2 <= h <= 1.0) - 0.5 * sum(a^2)`` with the speed dx along x in m/s and the height h in m after the
    step: Gymnasium's, without its cost of contact forces (0.0005 of their squares), which no observation has. The
    longest legs hold the torso at 0.88 m, so that the range of heights serves every design.

    The body at xi = 1 is Gymnasium's. Density is constant (5 kg/m^3). Legs start stretched out sideways, beyond the
    ranges of the ankles, which drive them down; the torso starts higher by what the ends of the longest legs then are
    lower, so that no leg is driven into the floor.

    Its arguments are those of :class:`~coim.envs.morph.MorphEnv`.

    Example:
        >>> env = AntMorph(num_runs=2, seed=0)
        >>> env.rollout(3)["next", "observation"].shape
        torch.Size([2, 3, 27])
    """

    ASSET = "ant.xml"
    SCALE: ClassVar = {
        f"{leg} {part}": (f"{leg} {part}".replace(" ", "_"),) for leg in LEGS for part in ("thigh", "shin")
    }
    DESIGN_SIZE = 8
    DESIGN_NAMES = tuple(SCALE)
    DESIGN_BOUNDS = (0.5, 1.5)
    FRAME_SKIP = 5
    RESET_NOISE = 0.1
    OBSERVATION_SCALE = (0.3, *[0.5] * 4, *[0.35] * 8, 0.8, 0.8, 0.9, *[2.0] * 3, *[4.5] * 8)  # m, 1, rad, m/s, rad/s
    # The unit body and four fixed draws from the uniform distribution: every run starts with the same five.
    FIRST_DESIGNS: ClassVar[tuple[tuple[float, ...], ...]] = (
        (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
        (1.14, 0.77, 0.54, 0.52, 1.31, 1.41, 1.11, 1.23),
        (1.04, 1.44, 1.32, 0.5, 1.36, 0.53, 1.23, 0.68),
        (1.36, 1.04, 0.8, 0.92, 0.53, 0.62, 1.17, 1.15),
        (1.12, 0.88, 1.5, 1.48, 1.19, 1.15, 1.19, 0.89),
    )
    HEALTHY = (0.2, 1.0)  # m
    EFFORT_COST = 0.5

    def draw_noise(self, num_positions: int, num_velocities: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw one row's noise for ``reset_noise=1``: uniform positions, normal velocities, as in Gymnasium."""
        return uniform_and_normal(num_positions, num_velocities, generator)

    @staticmethod
    def reward(
        observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor, task: Task = "forward"
    ) -> Tensor:
        """``dx + (0.2 <= h <= 1.0) - 0.5 * sum(a^2)`` for ``[*B, 27]`` observations, ``[*B, 1]``.

        Example:
            >>> next_observation = torch.zeros(27)
            >>> next_observation[0], next_observation[13] = 0.6, 2.0  # m, m/s
            >>> AntMorph.reward(torch.zeros(27), torch.full((8,), 0.5), next_observation, torch.ones(8))
            tensor([2.])
        """
        speed = speed_along(task, next_observation[..., FORWARD_VELOCITY, None])
        height = next_observation[..., HEIGHT, None]
        low, high = AntMorph.HEALTHY
        healthy = ((height >= low) & (height <= high)).to(speed.dtype)
        return speed + healthy - AntMorph.EFFORT_COST * action.square().sum(-1, keepdim=True)
