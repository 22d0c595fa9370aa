"""Hopper with a torso and one leg of variable length (Sec. 6.2).

Shapes: *B any batch, S = 11 observation, D = 4 design, A = 3 action.

References:
    Co-Imagination of Behaviour & Morphology of Agents, Sec. 6.2.
    Erez, Tassa, Todorov: Infinite-horizon model predictive control for periodic tasks with contacts, RSS 2011.
    Gymnasium's Hopper-v5, https://gymnasium.farama.org/environments/mujoco/hopper (its numbers).
"""

from __future__ import annotations

from typing import ClassVar

import mujoco
import numpy as np
from torch import Tensor

from coim.angles import wrap_angle
from coim.envs.morph import MorphEnv
from coim.envs.task import Task, speed_along
from coim.envs.walker import ANKLE, shape_leg, shape_torso

HEIGHT, PITCH_ANGLE, FORWARD_VELOCITY = 0, 1, 5  # entries of the observation
TORSO, THIGH, SHANK, FOOT = 0.4, 0.45, 0.5, 0.39  # m at xi = 1
TOE = 1 / 3  # share of the foot's length that is in front of the ankle


class HopperMorph(MorphEnv):
    """One-legged hopper in a plane whose four segment lengths are the design.

    ======  =======  =========  ===========
    design  segment  at xi = 1  range of xi
    ======  =======  =========  ===========
    0       torso    0.40 m     0.5 - 2.0
    1       thigh    0.45 m     0.5 - 2.0
    2       shank    0.50 m     0.5 - 2.0
    3       foot     0.39 m     0.5 - 2.0
    ======  =======  =========  ===========

    ===========  ============================================================  ============
    observation  quantity                                                      unit
    ===========  ============================================================  ============
    0            height of the torso's centre above the floor                  m
    1            pitch of the torso (``rooty``), wrapped to (-pi, pi]          rad
    2 - 4        joints: hip, knee, ankle                                      rad
    5, 6         velocity of the torso, horizontal and vertical                m/s
    7            angular velocity of the torso                                 rad/s
    8 - 10       angular velocities of the three joints, in the order above    rad/s
    ===========  ============================================================  ============

    The three actions are the torques of the three joints in the same order, as shares of 200 N m. A step takes 0.008 s.

    Reward: ``max(h > 0.5, 0.1) * (max(dx, 0) + 1) - 0.1 * abs(pitch)`` with the height h in m, the horizontal speed dx
    in m/s and the pitch in rad after the step, as printed.

    Its arguments are those of :class:`~coim.envs.morph.MorphEnv`.

    Example:
        >>> env = HopperMorph(num_runs=2, seed=0)
        >>> env.rollout(3)["next", "reward"].shape
        torch.Size([2, 3, 1])
    """

    ASSET = "hopper.xml"
    DESIGN_SIZE = 4
    DESIGN_NAMES = ("torso", "thigh", "shank", "foot")
    DESIGN_BOUNDS = (0.5, 2.0)
    FRAME_SKIP = 4
    RESET_NOISE = 0.005
    OBSERVATION_SCALE = (0.3, 1.5, 1.0, 1.0, 0.5, 0.5, 0.7, *[2.5] * 4)  # m, rad, m/s, rad/s
    # The unit body and four fixed draws from the uniform distribution: every run starts with the same five (Sec. 6.1).
    FIRST_DESIGNS: ClassVar[tuple[tuple[float, ...], ...]] = (
        (1.0, 1.0, 1.0, 1.0),
        (1.91, 1.27, 1.96, 0.62),
        (1.41, 1.06, 1.7, 0.76),
        (1.81, 1.32, 1.85, 1.22),
        (1.15, 1.68, 1.98, 1.05),
    )
    STANDING_HEIGHT = 0.5  # m; below it, the reward has only a tenth of the terms for speed and survival
    FALLEN_SHARE = 0.1
    PITCH_COST = 0.1  # 1/rad

    def shape_body(self, spec: mujoco.MjSpec, design: np.ndarray) -> None:
        """Set all lengths; the torso starts at the height of the extended leg."""
        torso, thigh, shank, foot = design * (TORSO, THIGH, SHANK, FOOT)
        shape_leg(spec, "", thigh=thigh, shank=shank, foot=foot, toe=TOE * foot)
        shape_torso(spec, torso, height=torso / 2 + thigh + shank + ANKLE)

    @staticmethod
    def reward(
        observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor, task: Task = "forward"
    ) -> Tensor:
        """``max(h > 0.5, 0.1) * (max(dx, 0) + 1) - 0.1 * abs(pitch)`` for ``[*B, 11]`` observations, ``[*B, 1]``.

        Example:
            >>> import torch
            >>> next_observation = torch.zeros(11)
            >>> next_observation[0], next_observation[5] = 1.2, 2.0  # m, m/s
            >>> HopperMorph.reward(torch.zeros(11), torch.zeros(3), next_observation, torch.ones(4))
            tensor([3.])
        """
        speed = speed_along(task, next_observation[..., FORWARD_VELOCITY, None])
        stands = next_observation[..., HEIGHT, None] > HopperMorph.STANDING_HEIGHT
        pitch = wrap_angle(next_observation[..., PITCH_ANGLE, None]).abs()
        share = stands.to(speed.dtype).clamp(min=HopperMorph.FALLEN_SHARE)
        return share * (speed.clamp(min=0) + 1) - HopperMorph.PITCH_COST * pitch
