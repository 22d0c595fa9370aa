"""Half-Cheetah with legs of variable length (Sec. 6.2).

Shapes: *B any batch, S = 17 observation, D = 6 design, A = 6 action.

References:
    Co-Imagination of Behaviour & Morphology of Agents, Sec. 6.2.
    Wawrzynski: A cat-like robot real-time learning to run, ICANNGA 2009 (the body).
    Gymnasium's HalfCheetah-v5, https://gymnasium.farama.org/environments/mujoco/half_cheetah (its numbers).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import mujoco
import numpy as np
import torch
from torch import Tensor

from coim.envs.morph import MorphEnv
from coim.envs.robot import Physics, uniform_and_normal
from coim.envs.task import Task, speed_along

LEGS = (("bthigh", "bshin", "bfoot"), ("fthigh", "fshin", "ffoot"))
PARTS = ("back thigh", "back shin", "back foot", "front thigh", "front shin", "front foot")
FORWARD_VELOCITY = -9  # entry of the observation, m/s


class HalfCheetahMorph(MorphEnv):
    """Two-legged cheetah in a plane whose six leg segments are the design.

    ======  ===========  =========  ==========
    design  segment      at xi = 1  range of xi
    ======  ===========  =========  ==========
    0       back thigh   0.290 m    0.8 - 2.0
    1       back shin    0.300 m    0.8 - 2.0
    2       back foot    0.188 m    0.8 - 2.0
    3       front thigh  0.266 m    0.8 - 2.0
    4       front shin   0.212 m    0.8 - 2.0
    5       front foot   0.140 m    0.8 - 2.0
    ======  ===========  =========  ==========

    ===========  ============================================================  ============
    observation  quantity                                                      unit
    ===========  ============================================================  ============
    0            height of the torso, relative to its start                    m
    1            pitch of the torso (``rooty``), wrapped to (-pi, pi]          rad
    2 - 4        joints ``bthigh``, ``bshin``, ``bfoot``                       rad
    5 - 7        joints ``fthigh``, ``fshin``, ``ffoot``                       rad
    8, 9         velocity of the torso, horizontal and vertical                m/s
    10           angular velocity of the torso                                 rad/s
    11 - 16      angular velocities of the six joints, in the order above      rad/s
    ===========  ============================================================  ============

    The six actions are the torques of the six joints in the same order, as shares of 120, 90, 60, 120, 60, 30 N m. A
    step takes 0.05 s.

    Reward: ``clamp(dx / 10, 0, 10)``, with the horizontal speed dx in m/s after the step. The paper prints
    max(dx / 10, 10), which would be constant at all possible speeds; its predecessor's code has max(dx / 10, 0).

    The paper prints the lengths of the back leg for the front leg too. The body at xi = 1 is Gymnasium's, whose front
    leg is shorter (see the table); ``segment_lengths=(0.29, 0.3, 0.188, 0.29, 0.3, 0.188)`` builds the printed one.
    Density is constant (660.885 kg/m^3, 14 kg at xi = 1), so longer legs are heavier and the torso keeps its mass.

    Keyword Args:
        segment_lengths: lengths at xi = 1 in m, in the order of the design; Gymnasium's by default.

    Its other arguments are those of :class:`~coim.envs.morph.MorphEnv`.

    Example:
        >>> from tensordict import TensorDict
        >>> env = HalfCheetahMorph(num_runs=2, seed=0)
        >>> long_legs = torch.full((2, 6), 1.5)
        >>> td = env.rollout(3, auto_reset=False, tensordict=env.reset(TensorDict({"design": long_legs}, [2])))
        >>> td["next", "observation"].shape
        torch.Size([2, 3, 17])
    """

    ASSET = "half_cheetah.xml"
    DESIGN_SIZE = 6
    DESIGN_NAMES = PARTS
    SCALE: ClassVar = {part: (geom,) for part, geom in zip(PARTS, (*LEGS[0], *LEGS[1]))}
    DESIGN_BOUNDS = (0.8, 2.0)
    FRAME_SKIP = 5
    RESET_NOISE = 0.1
    OBSERVATION_SCALE = (0.2, 1.5, *[0.3] * 6, 0.7, 0.7, 1.5, *[6.0] * 6)  # m, rad, m/s, rad/s
    SEGMENT_LENGTHS: ClassVar[tuple[float, ...]] = (0.29, 0.3, 0.188, 0.266, 0.212, 0.14)  # m, as drawn
    # The first five designs of the predecessor (Luck et al. 2019), the same for every run (Sec. 6.1).
    FIRST_DESIGNS: ClassVar[tuple[tuple[float, ...], ...]] = (
        (1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
        (1.41, 0.96, 1.97, 1.73, 1.97, 1.17),
        (1.52, 1.07, 1.11, 1.97, 1.51, 0.99),
        (1.08, 1.18, 1.39, 1.76, 1.85, 0.92),
        (0.85, 1.54, 0.97, 1.38, 1.10, 1.49),
    )

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
        segment_lengths: Sequence[float] = SEGMENT_LENGTHS,
    ) -> None:
        lengths = np.asarray(segment_lengths, dtype=np.float64)
        if lengths.shape != (6,) or not (np.isfinite(lengths) & (lengths > 0)).all():
            raise ValueError(
                f"segment_lengths {segment_lengths} are not six lengths in m, such as {self.SEGMENT_LENGTHS}"
            )
        self._stretch = lengths / self.SEGMENT_LENGTHS
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
        """Scale each segment and move its children; the feet start at the same height above the floor as at xi = 1."""
        drop_as_drawn = _leg_drop(spec)
        self._segments.stretch(spec, design * self._stretch)
        torso = spec.body("torso")
        torso.pos = torso.pos + np.array([0.0, 0.0, _leg_drop(spec) - drop_as_drawn])

    def draw_noise(self, num_positions: int, num_velocities: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw one row's noise for ``reset_noise=1``: uniform positions, normal velocities, as in Gymnasium."""
        return uniform_and_normal(num_positions, num_velocities, generator)

    @staticmethod
    def reward(
        observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor, task: Task = "forward"
    ) -> Tensor:
        """``clamp(dx / 10, 0, 10)`` for ``[*B, 17]`` observations, ``[*B, 1]``.

        The paper prints max(dx / 10, 10); this is read as a clamp from 0 to 10.

        Example:
            >>> next_observation = torch.zeros(17)
            >>> next_observation[8] = 3.0  # m/s
            >>> HalfCheetahMorph.reward(torch.zeros(17), torch.zeros(6), next_observation, torch.ones(6))
            tensor([0.3000])
        """
        return (speed_along(task, next_observation[..., FORWARD_VELOCITY, None]) / 10).clamp(0, 10)


def _leg_drop(spec: mujoco.MjSpec) -> float:
    """Return the distance in m from the torso's centre down to the lowest point of the legs, with all joints at 0."""
    lowest = 0.0
    for leg in LEGS:
        height = 0.0
        for name in leg:
            height += spec.body(name).pos[2]
            geom = spec.geom(name)
            half_rise = geom.size[1] * abs(np.cos(geom.alt.axisangle[3]))  # the capsules are rotated about y
            lowest = min(lowest, height + geom.pos[2] - half_rise - geom.size[0])
    return -lowest
