"""A fleet of simulated bodies with tensors as inputs and outputs, without TorchRL.

Shapes: K runs (rows of the fleet), S observation, D design, A action. All simulations run on the CPU.
"""

from __future__ import annotations

import functools
import math
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from coim.envs.camera import Camera
from coim.envs.kinematics import Kinematics
from coim.envs.planar import check_planar
from coim.envs.simulation import PITCH, ROOT_X, Simulations
from coim.randomness import restore_generator


class Fleet:
    """The bodies of :class:`~coim.envs.morph.MorphEnv`; a subclass defines them by constants and :meth:`shape_body`.

    Attributes:
        simulations: the simulations themselves: live positions and velocities, and the compiled bodies.
        num_broken: how often the simulation of each row has broken, ``[K]`` int64.
    """

    ASSET: ClassVar[str]  # XML file in assets/, or an absolute path
    DESIGN_SIZE: ClassVar[int]
    DESIGN_NAMES: ClassVar[tuple[str, ...]] = ()  # names of the design's entries; see design_names()
    DESIGN_BOUNDS: ClassVar[tuple[float, float]]
    FRAME_SKIP: ClassVar[int]  # simulation steps in an environment step
    RESET_NOISE: ClassVar[float]
    OBSERVATION_SCALE: ClassVar[tuple[float, ...]]  # standard deviations under random actions at xi = 1, rounded
    FIRST_DESIGNS: ClassVar[tuple[tuple[float, ...], ...]]  # the designs that a run tries first

    _first_position = 1  # index of the first observed entry of qpos: the root's x is not observed

    reset_noise: float

    def _begin(self, num_runs: int, num_threads: int) -> None:
        """Build K unit bodies."""
        self._num_threads = num_threads
        self._design = torch.ones(num_runs, self.DESIGN_SIZE, dtype=torch.float32, device="cpu")
        self.simulations = self._simulate()
        check_planar(self.simulations.model(0), type(self).__name__)
        self._observation = self._see()
        self._step_count = torch.zeros(num_runs, 1, dtype=torch.int64, device="cpu")
        self.num_broken = torch.zeros(num_runs, dtype=torch.int64, device="cpu")

    def _simulate(self) -> Simulations:
        """Make the simulations of the current designs."""
        return Simulations(
            mujoco.MjSpec.from_file(str(Path(__file__).parent / "assets" / self.ASSET)),
            shape_body=self.shape_body,
            designs=self._design.numpy(),
            num_threads=self._num_threads,
        )

    @abstractmethod
    def shape_body(self, spec: mujoco.MjSpec, design: np.ndarray) -> None:
        """Change the body at xi = 1 into the body of a design, in place.

        Args:
            spec: the body of the XML file, xi = 1.
            design: scale factors within the bounds, ``[D]`` float64.
        """

    def clearance(self, observation: Tensor, design: Tensor) -> Tensor:
        """Height in m of a body's lowest point above the floor, negative below it; differentiable in both arguments.

        Args:
            observation: ``[*B, S]``.
            design: ``[*B, D]``.

        Returns:
            ``[*B, 1]``, equal to MuJoCo's geometry up to the precision of the observation.

        Example:
            >>> from coim import HopperMorph
            >>> env = HopperMorph(reset_noise=0.0)
            >>> standing = env.reset()
            >>> env.clearance(standing["observation"], standing["design"])  # the soles start 4 cm above the floor
            tensor([[0.0400]])
        """
        positions = observation[..., : self._kinematics.num_positions - self._first_position]
        unseen = positions.new_zeros(*positions.shape[:-1], self._first_position)
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
        height = self._kinematics.height - self._first_position
        observation = observation.expand(*rise.shape[:-1], -1)
        before, after = observation[..., :height], observation[..., height + 1 :]
        return torch.cat([before, observation[..., height, None] + rise, after], -1)

    @functools.cached_property
    def _kinematics(self) -> Kinematics:
        bodies = self.simulations
        return Kinematics(
            lambda design: bodies.body(design).compile(), bounds=self.DESIGN_BOUNDS, size=self.DESIGN_SIZE
        )

    def draw_noise(self, num_positions: int, num_velocities: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw one row's noise for ``reset_noise=1``: positions and velocities, uniform in [-1, 1], float64."""
        size = num_positions + num_velocities
        noise = 2 * torch.rand(size, generator=generator, dtype=torch.float64, device="cpu") - 1
        return noise[:num_positions], noise[num_positions:]

    def move(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Step the fleet on tensors, without a reward.

        Args:
            action: motor torques as shares of the motors' strength, ``[K, A]``; MuJoCo clips them to [-1, 1].

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
            raise ValueError(f"action {action.tolist()} is not finite; the policy that gave it has diverged")
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

    def place(self, observation: Tensor, design: Tensor) -> None:
        """Set the state and the body of each simulation, to compare a learnt model with the simulator.

        Args:
            observation: ``[K, S]``; if it does not have the root's x, that becomes 0.
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
        num_positions = qpos.shape[1] - self._first_position
        qpos[:, ROOT_X] = 0.0
        qpos[:, self._first_position :] = state[:, :num_positions]
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
        """Return the current outline of one row, ``[segments, 5]``: x and z of both ends and the radius, in m."""
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
        return Camera(self.simulations.body(self._design[run].numpy()), width=width, height=height)

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
        low, high = torch.tensor(self.DESIGN_BOUNDS, dtype=torch.float32, device="cpu")
        if not bool(((wanted >= low) & (wanted <= high)).all()):  # NaN is neither
            raise ValueError(
                f"design {wanted.tolist()} leaves [{low:.4g}, {high:.4g}]; clip it with design_spec.project()"
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
            simulations.lift_out_of_floor(row)
        self._step_count[rows] = 0
        self._observation[rows] = self._see()[rows]

    def _see(self) -> Tensor:
        """Return the current observation ``[K, S]``: ``qpos, qvel`` with the pitch wrapped."""
        state = np.concatenate((self.simulations.qpos[:, self._first_position :], self.simulations.qvel), axis=1)
        pitch = state[:, PITCH - self._first_position]
        pitch -= math.tau * np.ceil(pitch / math.tau - 0.5)  # wrap_angle, before precision is lost to float32
        return torch.from_numpy(state.astype(np.float32))
