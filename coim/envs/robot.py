"""A kind of robot: its file, what a design makes of it, and where the states of its bodies are above the floor.

Nothing here depends on where a simulation stands; that is `coim.envs.fleet`.

Shapes: K runs, S observation, D design.
"""

from __future__ import annotations

import functools
import re
from pathlib import Path
from typing import Any, ClassVar, Literal

import mujoco
import numpy as np
import torch
from torch import Tensor

from coim.envs.kinematics import Kinematics
from coim.envs.root import Root, give_floor
from coim.envs.segments import Scale, Segments, keep_densities
from coim.envs.simulation import Simulations
from coim.envs.warp_simulations import WarpSimulations

Bounds = tuple[float, float] | tuple[tuple[float, float], ...]
Physics = Literal["mujoco", "warp"]


def uniform_and_normal(num_positions: int, num_velocities: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Draw one row's noise as Gymnasium does for its cheetah and its ant: uniform in [-1, 1], and standard normal."""
    positions = 2 * torch.rand(num_positions, generator=generator, dtype=torch.float64, device="cpu") - 1
    return positions, torch.randn(num_velocities, generator=generator, dtype=torch.float64, device="cpu")


class Robot:
    """A kind of robot; a subclass defines its bodies by constants, and by :meth:`shape_body` if ``SCALE`` cannot.

    Attributes:
        simulations: the simulations of bodies of this kind.
        root: how the robot moves, and where its place stands in its positions.
    """

    ASSET: ClassVar[str]  # XML file in assets/, or an absolute path
    SCALE: ClassVar[Scale] = {}  # what each entry of a design scales, see `coim.envs.segments`
    DESIGN_SIZE: ClassVar[int]
    DESIGN_NAMES: ClassVar[tuple[str, ...]] = ()  # names of the design's entries; see design_names()
    DESIGN_BOUNDS: ClassVar[Bounds]  # lowest and highest factor, of all entries or a pair for each
    FRAME_SKIP: ClassVar[int]  # simulation steps in an environment step
    RESET_NOISE: ClassVar[float]
    OBSERVATION_SCALE: ClassVar[tuple[float, ...]]  # standard deviations under random actions at xi = 1, rounded
    FIRST_DESIGNS: ClassVar[tuple[tuple[float, ...], ...]]  # the designs that a run tries first
    CAMERA: ClassVar[str | None] = None  # name of a camera of the file for pictures; by default its first one, or ours

    simulations: Simulations
    root: Root
    _observes_place = False  # whether the robot's place on the ground is observed

    def _simulate(
        self, designs: np.ndarray, num_threads: int, *, physics: Physics = "mujoco", device: str = "cpu"
    ) -> Simulations:
        """Make the simulations of the bodies of designs ``[K, D]``."""
        drawn = mujoco.MjSpec.from_file(str(Path(__file__).parent / "assets" / self.ASSET))
        if self.SCALE:
            keep_densities(drawn)
        give_floor(drawn)
        if self.SCALE:
            self._segments = Segments(drawn, self.SCALE)
        how: dict[str, Any] = {"shape_body": self.shape_body, "designs": designs, "num_threads": num_threads}
        if physics == "mujoco":
            return Simulations(drawn, **how)
        return WarpSimulations(drawn, device=device, **how)

    def shape_body(self, spec: mujoco.MjSpec, design: np.ndarray) -> None:
        """Change the body at xi = 1 into the body of a design, in place; by default as ``SCALE`` says.

        Args:
            spec: the body of the XML file, xi = 1.
            design: scale factors within the bounds, ``[D]`` float64.
        """
        if not self.SCALE:
            raise NotImplementedError(f"{type(self).__name__} has neither SCALE nor shape_body(); give it one of them")
        self._segments.shape(spec, design)

    @classmethod
    def design_names(cls) -> tuple[str, ...]:
        """Return names of the D entries of a design: ``DESIGN_NAMES``, or by default ``design 0, design 1, ...``.

        Raises:
            ValueError: if they are not D different names of letters, digits and single spaces between words.
        """
        if not cls.DESIGN_NAMES:
            return tuple(f"design {i}" for i in range(cls.DESIGN_SIZE))
        names = tuple(cls.DESIGN_NAMES)
        plain = all(isinstance(name, str) and re.fullmatch(r"[^\W_]+( [^\W_]+)*", name) for name in names)
        if not plain or len(set(names)) != len(names) or len(names) != cls.DESIGN_SIZE:
            raise ValueError(
                f"{cls.__name__}.DESIGN_NAMES is {names}, not {cls.DESIGN_SIZE} different names of letters, digits and "
                "single spaces, one for each entry of the design; leave it out to count them"
            )
        return names

    @classmethod
    def design_bounds(cls) -> tuple[Tensor, Tensor]:
        """Return the lowest and the highest factor of each entry of a design, ``[D]`` float64 on the CPU."""
        bounds = torch.tensor(cls.DESIGN_BOUNDS, dtype=torch.float64, device="cpu").expand(cls.DESIGN_SIZE, 2)
        return bounds[:, 0], bounds[:, 1]

    @property
    def first_position(self) -> int:
        """Index of the first observed entry of qpos."""
        return 0 if self._observes_place else self.root.unseen

    def clearance(self, observation: Tensor, design: Tensor) -> Tensor:
        """Height in m of a body's lowest point above the floor, negative below it; differentiable in both arguments.

        Args:
            observation: ``[*B, S]``.
            design: ``[*B, D]``.

        Returns:
            ``[*B, 1]``, equal to MuJoCo's geometry up to the precision of the observation.

        Raises:
            ValueError: if nothing moves the body up and down, as on a fixed base, or it has lengths or shapes whose
                lowest point is not known.

        Example:
            >>> from coim import HopperMorph
            >>> env = HopperMorph(reset_noise=0.0)
            >>> standing = env.reset()
            >>> env.clearance(standing["observation"], standing["design"])  # the soles start 4 cm above the floor
            tensor([[0.0400]])
        """
        positions = observation[..., : self._kinematics.num_positions - self.first_position]
        unseen = positions.new_zeros(*positions.shape[:-1], self.first_position)
        return self._kinematics.lowest(torch.cat([unseen, positions], -1), design)

    def transfer(self, observation: Tensor, design: Tensor, new_design: Tensor) -> Tensor:
        """Transfer the state of one body to another: same joints, velocities and clearance; the root moves up or down.

        A state has the height of the root, which depends on the legs. With other legs and the same height, a foot would
        be in the floor or the body in the air: a state that the other body cannot be in.

        Args:
            observation: ``[*B, S]``.
            design: ``[*B, D]``, the body of the state.
            new_design: ``[*B, D]``. The batches of the three are broadcast: ``[n, S], [n, D], [P, 1, D]`` puts each of
                n states under each of P bodies.

        Returns:
            ``[*B, S]``; the transfer back gives the observation again, and the same design leaves it as it is, to the
            last bit. Differentiable in all three.

        Example:
            >>> from coim import HopperMorph
            >>> env = HopperMorph(reset_noise=0.0)
            >>> standing = env.reset()
            >>> legs = standing["design"] * torch.tensor([1.0, 2.0, 1.0, 1.0])  # a thigh of 0.9 m instead of 0.45 m
            >>> env.transfer(standing["observation"], standing["design"], legs)[0, 0] - standing["observation"][0, 0]
            tensor(0.4500)
        """
        rise = self.clearance(observation, design) - self.clearance(observation, new_design)
        height = self._kinematics.height - self.first_position
        observation = observation.expand(*rise.shape[:-1], -1)
        before, after = observation[..., :height], observation[..., height + 1 :]
        return torch.cat([before, observation[..., height, None] + rise, after], -1)

    @functools.cached_property
    def _kinematics(self) -> Kinematics:
        bodies = self.simulations
        return Kinematics(
            lambda design: bodies.body(design).compile(), bounds=self.design_bounds(), size=self.DESIGN_SIZE
        )

    def draw_noise(self, num_positions: int, num_velocities: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw one row's noise for ``reset_noise=1``: positions and velocities, uniform in [-1, 1], float64."""
        size = num_positions + num_velocities
        noise = 2 * torch.rand(size, generator=generator, dtype=torch.float64, device="cpu") - 1
        return noise[:num_positions], noise[num_positions:]
