"""Walker with a torso and two legs of variable length (Sec. 6.2).

Shapes: *B any batch, S = 18 observation, D = 7 design, A = 6 action.

References:
    Co-Imagination of Behaviour & Morphology of Agents, Sec. 6.2.
    Erez, Tassa, Todorov: Infinite-horizon model predictive control for periodic tasks with contacts, RSS 2011.
    Gymnasium's Walker2d-v5, https://gymnasium.farama.org/environments/mujoco/walker2d (its numbers).
"""

from __future__ import annotations

from typing import ClassVar

import mujoco
import numpy as np
import torch
from torch import Tensor

from coim.angles import wrap_angle
from coim.envs.morph import MorphEnv
from coim.envs.robot import Physics
from coim.envs.task import Task, speed_along

HEIGHT, PITCH_ANGLE, FORWARD_VELOCITY = -17, -16, -9  # entries of the observation, with or without root x in front
TORSO, THIGH, KNEE, FOOT = 0.4, 0.45, 0.6, 0.2  # m at xi = 1; KNEE is its height above the sole's axis
ANKLE = 0.1  # m from the end of the shank to the axis of the foot's capsule


class WalkerMorph(MorphEnv):
    """Two-legged walker in a plane whose seven segment lengths are the design.

    ======  ========================================  =========  ===========
    design  segment                                   at xi = 1  range of xi
    ======  ========================================  =========  ===========
    0       torso                                     0.40 m     0.5 - 2.0
    1, 4    thigh, right and left                     0.45 m     0.5 - 2.0
    2, 5    height of the knee, right and left        0.60 m     0.5 - 2.0
    3, 6    foot, right and left                      0.20 m     0.5 - 2.0
    ======  ========================================  =========  ===========

    ===========  ============================================================  ============
    observation  quantity                                                      unit
    ===========  ============================================================  ============
    0            distance travelled (``rootx``)                                m
    1            height of the torso's centre above the floor                  m
    2            pitch of the torso (``rooty``), wrapped to (-pi, pi]          rad
    3 - 5        joints of the right leg: hip, knee, ankle                     rad
    6 - 8        joints of the left leg: hip, knee, ankle                      rad
    9, 10        velocity of the torso, horizontal and vertical                m/s
    11           angular velocity of the torso                                 rad/s
    12 - 17      angular velocities of the six joints, in the order above      rad/s
    ===========  ============================================================  ============

    The six actions are the torques of the six joints in the same order, as shares of 100 N m. A step takes 0.008 s.

    Reward: ``((h > 0.8) * (max(dx, 0) + 1) - 0.1 * abs(pitch)) / 10`` with the height h in m, the horizontal speed dx
    in m/s and the pitch in rad after the step, as printed.

    Note:
        0.8 m is an absolute height. A body that is too small can never reach it (2 in 10,000 uniform designs).

    Keyword Args:
        observe_root_x: observe the distance travelled, the first of the paper's 18 dimensions; Gymnasium leaves it out.

    Its other arguments are those of :class:`~coim.envs.morph.MorphEnv`.

    Example:
        >>> env = WalkerMorph(num_runs=2, seed=0)
        >>> env.rollout(3)["next", "reward"].shape
        torch.Size([2, 3, 1])
    """

    ASSET = "walker.xml"
    DESIGN_SIZE = 7
    DESIGN_NAMES = ("torso", "right thigh", "right knee", "right foot", "left thigh", "left knee", "left foot")
    DESIGN_BOUNDS = (0.5, 2.0)
    FRAME_SKIP = 4
    RESET_NOISE = 0.005
    # The same for both legs. 5 m is the distance that a walking body covers; random actions stay within 1 m.
    OBSERVATION_SCALE = (5.0, 0.25, 1.5, *[0.9, 0.9, 0.6] * 2, 1.1, 1.3, 8.0, *[9.5, 6.0, 15.0] * 2)
    # The unit body and four fixed draws from the uniform distribution: every run starts with the same five (Sec. 6.1).
    FIRST_DESIGNS: ClassVar[tuple[tuple[float, ...], ...]] = (
        (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
        (1.44, 1.85, 1.66, 0.84, 0.95, 1.81, 0.51),
        (1.73, 1.7, 1.2, 0.95, 0.92, 0.88, 1.17),
        (1.26, 1.33, 1.99, 1.69, 1.43, 1.98, 0.82),
        (0.74, 1.42, 0.57, 0.55, 1.27, 1.2, 1.88),
    )
    STANDING_HEIGHT = 0.8  # m; below it, the reward has no terms for speed and survival
    PITCH_COST = 0.1  # 1/rad

    def __init__(
        self,
        *,
        num_runs: int = 1,
        task: Task = "forward",
        episode_steps: int = 1000,
        reset_noise: float | None = None,
        seed: int | None = None,
        num_threads: int = 1,
        device: torch.device | str | None = None,
        physics: Physics = "mujoco",
        observe_root_x: bool = True,
    ) -> None:
        self._observes_place = observe_root_x
        super().__init__(
            num_runs=num_runs,
            task=task,
            episode_steps=episode_steps,
            reset_noise=reset_noise,
            seed=seed,
            num_threads=num_threads,
            device=device,
            physics=physics,
        )

    def shape_body(self, spec: mujoco.MjSpec, design: np.ndarray) -> None:
        """Set all lengths; the torso starts at the height of the longer leg."""
        legs = {"": design[1:4], "_left": design[4:7]}
        for side, scales in legs.items():
            thigh, knee, foot = scales * (THIGH, KNEE, FOOT)
            shape_leg(spec, side, thigh=thigh, shank=knee - ANKLE, foot=foot, toe=foot)
        torso = TORSO * design[0]
        shape_torso(spec, torso, height=torso / 2 + max(THIGH * leg[0] + KNEE * leg[1] for leg in legs.values()))

    @staticmethod
    def reward(
        observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor, task: Task = "forward"
    ) -> Tensor:
        """``((h > 0.8) * (max(dx, 0) + 1) - 0.1 * abs(pitch)) / 10`` for 18 or 17 observed numbers, ``[*B, 1]``.

        Example:
            >>> next_observation = torch.zeros(18)
            >>> next_observation[1], next_observation[9] = 1.2, 2.0  # m, m/s
            >>> WalkerMorph.reward(torch.zeros(18), torch.zeros(6), next_observation, torch.ones(7))
            tensor([0.3000])
        """
        speed = speed_along(task, next_observation[..., FORWARD_VELOCITY, None])
        stands = next_observation[..., HEIGHT, None] > WalkerMorph.STANDING_HEIGHT
        pitch = wrap_angle(next_observation[..., PITCH_ANGLE, None]).abs()
        return (stands * (speed.clamp(min=0) + 1) - WalkerMorph.PITCH_COST * pitch) / 10


def shape_torso(spec: mujoco.MjSpec, length: float, *, height: float) -> None:
    """Set the length of the torso and the height of its centre at the start, in m; the legs join its lower end."""
    torso = spec.body("torso")
    torso.pos = [0.0, 0.0, height]
    for name in ("rootx", "rootz"):
        spec.joint(name).pos = [0.0, 0.0, -height]
    spec.joint("rootz").ref = height  # then qpos[1] is the height above the floor
    _set_half_length(spec.geom("torso"), length / 2)
    for thigh in torso.bodies:
        thigh.pos = [0.0, 0.0, -length / 2]


def shape_leg(spec: mujoco.MjSpec, side: str, *, thigh: float, shank: float, foot: float, toe: float) -> None:
    """Set the lengths of one leg in m.

    Args:
        spec: the body.
        side: suffix of the names of this leg's parts.
        thigh: from hip to knee.
        shank: from knee to the end of the shank; the foot's axis lies 0.1 m lower.
        foot: between the centres of the foot's round ends.
        toe: from the ankle to the centre of the foot's front end.
    """
    spec.geom(f"thigh{side}").pos = [0.0, 0.0, -thigh / 2]
    _set_half_length(spec.geom(f"thigh{side}"), thigh / 2)
    spec.body(f"leg{side}").pos = [0.0, 0.0, -thigh - shank / 2]
    spec.joint(f"leg{side}").pos = [0.0, 0.0, shank / 2]
    _set_half_length(spec.geom(f"leg{side}"), shank / 2)
    spec.body(f"foot{side}").pos = [toe, 0.0, -shank / 2 - ANKLE]
    spec.joint(f"foot{side}").pos = [-toe, 0.0, ANKLE]
    spec.geom(f"foot{side}").pos = [-toe / 2, 0.0, ANKLE]
    _set_half_length(spec.geom(f"foot{side}"), foot / 2)


def _set_half_length(capsule: mujoco.MjsGeom, half_length: float) -> None:
    capsule.size = [capsule.size[0], half_length, 0.0]
