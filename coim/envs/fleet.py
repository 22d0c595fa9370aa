"""A fleet of simulated bodies with tensors as inputs and outputs, without TorchRL.

Shapes: K runs (rows of the fleet), S observation, D design, A action. All simulations run on the CPU.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from coim.envs.camera import Camera, make_room
from coim.envs.kinematics import Kinematics
from coim.envs.root import Root, give_floor, read_root
from coim.envs.segments import Scale, Segments, keep_densities
from coim.envs.simulation import Simulations
from coim.randomness import restore_generator

Bounds = tuple[float, float] | tuple[tuple[float, float], ...]


def uniform_and_normal(num_positions: int, num_velocities: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Draw one row's noise as Gymnasium does for its cheetah and its ant: uniform in [-1, 1], and standard normal."""
    positions = 2 * torch.rand(num_positions, generator=generator, dtype=torch.float64, device="cpu") - 1
    return positions, torch.randn(num_velocities, generator=generator, dtype=torch.float64, device="cpu")


def not_finite(action: Tensor) -> ValueError:
    """The error of an action that is not finite."""
    return ValueError(f"action {action.tolist()} is not finite; the policy that gave it has diverged")


class Fleet:
    """The bodies of :class:`~coim.envs.morph.MorphEnv`; a subclass defines them by constants and :meth:`shape_body`.

    Attributes:
        simulations: the simulations themselves: live positions and velocities, and the compiled bodies.
        num_broken: how often the simulation of each row has broken, ``[K]`` int64.
        root: how the robot moves, and where its place stands in its positions.
        motor_range: middle and reach of the control of each motor, ``[A]`` each; None where all are [-1, 1].
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

    root: Root
    reset_noise: float
    _observes_place = False  # whether the robot's place on the ground is observed

    def _begin(self, num_runs: int, num_threads: int) -> None:
        """Build K unit bodies."""
        self._num_threads = num_threads
        self._design = torch.ones(num_runs, self.DESIGN_SIZE, dtype=torch.float32, device="cpu")
        self.simulations = self._simulate()
        model = self.simulations.model(0)
        self.root = read_root(model, type(self).__name__)
        low, high = model.actuator_ctrlrange.T
        self.motor_range = None if (low == -1).all() and (high == 1).all() else ((low + high) / 2, (high - low) / 2)
        self._observation = self._see()
        self._step_count = torch.zeros(num_runs, 1, dtype=torch.int64, device="cpu")
        self.num_broken = torch.zeros(num_runs, dtype=torch.int64, device="cpu")

    def _simulate(self) -> Simulations:
        """Make the simulations of the current designs."""
        drawn = mujoco.MjSpec.from_file(str(Path(__file__).parent / "assets" / self.ASSET))
        if self.SCALE:
            keep_densities(drawn)
        give_floor(drawn)
        if self.SCALE:
            self._segments = Segments(drawn, self.SCALE)
        return Simulations(
            drawn,
            shape_body=self.shape_body,
            designs=self._design.numpy(),
            num_threads=self._num_threads,
        )

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

    def move(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Step the fleet on tensors, without a reward.

        Args:
            action: ``[K, A]``; -1 and 1 are the ends of each motor's ``ctrlrange``, to which MuJoCo clips.

        Returns:
            Next observation ``[K, S]`` and whether the simulation broke ``[K, 1]``, on the action's device. If the
            actions are on the CPU, no other device is used.

        Raises:
            ValueError: if the action has another shape, or a number that is not finite; the bodies have not moved then.
        """
        device, action = action.device, action.detach().cpu()
        if action.shape != self.simulations.ctrl.shape:
            raise ValueError(
                f"action has shape {list(action.shape)}, the fleet takes {list(self.simulations.ctrl.shape)}"
            )
        torques = action.numpy()
        if not math.isfinite(torques.sum()):
            raise not_finite(action)
        if self.motor_range is not None:
            middle, reach = self.motor_range
            torques = middle + reach * torques
        self.simulations.ctrl[:] = torques
        broken = self.simulations.step(self.FRAME_SKIP)
        observation = self._see()
        terminated = torch.zeros(len(action), 1, dtype=torch.bool, device="cpu")
        if broken.size:
            observation[broken] = self._observation[broken]
            terminated[broken] = True
            self.num_broken[broken] += 1
        self._observation = observation.clone()  # our own copy: the caller may write to the returned one
        self._step_count += 1
        return observation.to(device), terminated.to(device)

    def have_moved(self, rows: np.ndarray, steps: Tensor) -> None:
        """Take note that the simulations of some rows were stepped by somebody else than :meth:`move`.

        Args:
            rows: indices of the rows, ``[N]``.
            steps: how often each row of the fleet was stepped, ``[K]``.
        """
        self._observation[rows] = self._see()[rows]
        self._step_count[rows] += steps[rows].unsqueeze(-1)

    def place(self, observation: Tensor, design: Tensor) -> None:
        """Set the state and the body of each simulation, to compare a learnt model with the simulator.

        Args:
            observation: ``[K, S]``; what it does not have of the robot's place on the ground becomes 0.
            design: ``[K, D]``.

        Raises:
            ValueError: if a shape is wrong, a number is not finite, or a design is out of bounds.

        Note:
            An observation does not have the solver's warm start. The next step equals the original one up to the
            precision of float32, not to the last bit.
        """
        state = observation.detach().cpu().double().numpy()
        if state.shape != self._observation.shape or not np.isfinite(state).all():
            raise ValueError(
                f"observation must be finite and of shape {list(self._observation.shape)}, got {observation}"
            )
        rows = np.arange(len(state))
        self._build(design, rows)
        self.simulations.start(rows)
        qpos, qvel = self.simulations.qpos, self.simulations.qvel
        num_positions = qpos.shape[1] - self.first_position
        qpos[:, : self.first_position] = 0.0
        qpos[:, self.first_position :] = state[:, :num_positions]
        qvel[:] = state[:, num_positions:]
        self._step_count.zero_()
        self._observation = self._see()

    @contextmanager
    def holding(self, rows: Tensor | None) -> Iterator[None]:
        """Keep the state of some rows while the fleet moves.

        Args:
            rows: ``[K]`` bool, on the CPU; None keeps none.
        """
        if rows is None:
            yield
            return
        before = self.get_simulation_state()[rows]
        yield
        self.simulations.state[rows.numpy()] = before["simulation"].numpy()
        for key, value in (
            ("observation", self._observation),
            ("step_count", self._step_count),
            ("num_broken", self.num_broken),
        ):
            value[rows] = before[key]

    def get_simulation_state(self) -> TensorDict:
        """Return everything that later steps and resets depend on, ``[K]``: bodies, simulations, generators, counters.

        Another fleet can load rows of it, and then continues exactly as these rows would, to the last bit.
        """
        state = {
            "design": self._design,
            "observation": self._observation,
            "simulation": torch.from_numpy(self.simulations.state),
            "generator": torch.stack([generator.get_state() for generator in self._generators]),
            "step_count": self._step_count,
            "num_broken": self.num_broken,
        }
        return TensorDict(state, [len(self._design)], device="cpu").clone()

    def set_simulation_state(self, state: TensorDictBase) -> None:
        """Continue from a state of :meth:`get_simulation_state`.

        Raises:
            ValueError: if the state has another number of runs.
        """
        if state.batch_size != self._design.shape[:1]:
            raise ValueError(
                f"the state holds {state.numel()} runs, this fleet has {len(self._design)}; index it to select some"
            )
        state = state.clone().cpu()
        self._build(state["design"], np.arange(len(self._design)))
        self.simulations.state[:] = state["simulation"].numpy()
        for generator, generator_state in zip(self._generators, state["generator"]):
            restore_generator(generator, generator_state)
        self._observation, self._step_count, self.num_broken = (
            state[key] for key in ("observation", "step_count", "num_broken")
        )

    def capsules(self, run: int = 0) -> Tensor:
        """Return where one row's parts are, as it stands now; what is no capsule is drawn by several, side by side.

        Returns:
            ``[capsules, 7]``: x, y and z of both ends and the radius, in m; the ends of a sphere are its centre.

        Note:
            Boxes, cylinders and ellipsoids have rounded edges then, and a mesh is the box around it.
        """
        return torch.from_numpy(self.simulations.capsules(run))

    def render(self, run: int = 0, *, width: int = 480, height: int = 360) -> np.ndarray:
        """Draw one row in its current pose, ``[height, width, 3]`` uint8; about 0.1 s without a graphics card.

        Raises:
            RuntimeError: if there is no OpenGL; the message says what to set and install.
        """
        with self.camera(run, width=width, height=height) as camera:
            return camera.photograph(self.simulations.qpos[run])

    def camera(self, run: int = 0, *, width: int = 480, height: int = 360) -> Camera:
        """Return a camera for many pictures of one row's current body, in any pose ``qpos``; see :meth:`render`."""
        body = self.drawn_body(self._design[run].numpy())
        return Camera(body, width=width, height=height, name=self.CAMERA, root=self.root)

    def drawn_body(self, design: np.ndarray) -> mujoco.MjSpec:
        """Return the body of a design ``[D]`` for pictures: all designs of a class are drawn to one scale."""
        body = self.simulations.body(design)
        make_room(body, self.simulations.body(self.design_bounds()[1].numpy()).compile())
        return body

    @property
    def step_seconds(self) -> float:
        """Simulated time of one step, in s."""
        return self.FRAME_SKIP * self.simulations.model(0).opt.timestep

    def _seed_rows(self, seed: int) -> None:
        """Give each row its own generator, derived from (seed, row)."""
        rows = range(len(self._design))
        words = [np.random.SeedSequence([seed, row]).generate_state(1, np.uint32)[0] for row in rows]
        self._generators = [torch.Generator("cpu").manual_seed(int(word)) for word in words]

    def _build(self, design: Tensor, rows: np.ndarray) -> None:
        """Check the designs of the given rows, ``design [K, D]``, and build the new ones."""
        if design.shape != self._design.shape:
            raise ValueError(f"design has shape {list(design.shape)}, this fleet takes {list(self._design.shape)}")
        wanted = design.detach().to("cpu", torch.float32)[rows]
        low, high = (bound.float() for bound in self.design_bounds())
        outside = ~((wanted >= low) & (wanted <= high))  # NaN is neither
        if outside.any():
            entry = int(outside.nonzero()[0, -1])
            raise ValueError(
                f"design {wanted.tolist()} with its {self.design_names()[entry]} leaves "
                f"[{low[entry]:.4g}, {high[entry]:.4g}]; clip it with design_spec.project()"
            )
        changed = (wanted != self._design[rows]).any(-1).numpy()
        if changed.any():
            self.simulations.build(rows[changed], wanted[changed].numpy())
            self._design[rows] = wanted

    def _start(self, rows: np.ndarray) -> None:
        """Start new episodes: the start pose of each body, plus the row's own noise, with no foot in the floor."""
        simulations = self.simulations
        simulations.start(rows)
        for row in rows:
            positions, velocities = self.draw_noise(
                simulations.qpos.shape[1], simulations.qvel.shape[1], self._generators[row]
            )
            simulations.qpos[row] += self.reset_noise * positions.numpy()
            simulations.qvel[row] += self.reset_noise * velocities.numpy()
            if (at := self.root.quaternion) is not None:
                simulations.qpos[row, at : at + 4] /= np.linalg.norm(simulations.qpos[row, at : at + 4])
            simulations.lift_out_of_floor(row)
        self._step_count[rows] = 0
        self._observation[rows] = self._see()[rows]

    def _see(self) -> Tensor:
        """Return the current observation ``[K, S]``: ``qpos, qvel`` with angles wrapped."""
        first = self.first_position
        state = np.concatenate((self.simulations.qpos[:, first:], self.simulations.qvel), axis=1)
        for entry in self.root.angles:
            angle = state[:, entry - first]
            angle -= math.tau * np.ceil(angle / math.tau - 0.5)  # wrap_angle, before precision is lost to float32
        return torch.from_numpy(state.astype(np.float32))
