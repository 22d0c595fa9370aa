"""A fleet of simulated bodies with tensors as inputs and outputs, without TorchRL.

Shapes: K runs (rows of the fleet), S observation, D design, A action.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from coim.envs.camera import Camera, make_room
from coim.envs.robot import Robot
from coim.envs.root import read_root
from coim.randomness import restore_generator


def not_finite(action: Tensor) -> ValueError:
    """The error of an action that is not finite."""
    return ValueError(f"action {action.tolist()} is not finite; the policy that gave it has diverged")


class Fleet(Robot):
    """The bodies of :class:`~coim.envs.morph.MorphEnv`, of one kind of robot, stepped side by side.

    Attributes:
        simulations: the simulations themselves: live positions and velocities, and the compiled bodies.
        num_broken: how often the simulation of each row has broken, ``[K]`` int64.
        motor_range: middle and reach of the control of each motor, ``[A]`` each; None where all are [-1, 1].
    """

    reset_noise: float

    def _begin(self, num_runs: int, **simulated: Any) -> None:
        """Build K unit bodies, simulated as :meth:`_simulate` takes it."""
        self._simulated = simulated
        self._design = torch.ones(num_runs, self.DESIGN_SIZE, dtype=torch.float32, device="cpu")
        self.simulations = self._simulate(self._design.numpy(), **simulated)
        model = self.simulations.model(0)
        self.root = read_root(model, type(self).__name__)
        low, high = model.actuator_ctrlrange.T
        self.motor_range = None if (low == -1).all() and (high == 1).all() else ((low + high) / 2, (high - low) / 2)
        self._observation = self._see()
        self._step_count = torch.zeros(num_runs, 1, dtype=torch.int64, device="cpu")
        self.num_broken = torch.zeros(num_runs, dtype=torch.int64, device="cpu")

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
