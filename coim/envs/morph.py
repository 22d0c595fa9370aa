"""A fleet of robots whose bodies are set by a design, as a TorchRL environment: what all morphs share.

Shapes: K runs (rows of the fleet), S observation, D design, A action.

References:
    Co-Imagination of Behaviour & Morphology of Agents, Sec. 3 (the design as a context of the MDP) and Sec. 6.
    Towers et al.: Gymnasium, a standard interface for reinforcement learning environments,
    https://gymnasium.farama.org.
"""

from __future__ import annotations

import functools
import math
import re
from abc import abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from coim.envs.camera import Camera
from coim.envs.simulation import PITCH, ROOT_X, Simulations
from coim.envs.task import Task, speed_along
from coim.randomness import restore_generator

DONE_KEYS = ("done", "terminated", "truncated")


class MorphEnv(EnvBase):
    """A fleet of robots whose bodies are set by a design vector at reset.

    A new body is a subclass: an XML file, the constants below, :meth:`shape_body` (which lengths scale) and
    :meth:`reward`.

    The design enters through the reset tensordict, ``env.reset(TensorDict({"design": xi}, [K]))``, and stays until
    another one comes: auto-resets, partial resets and resets without ``design`` keep it. The unit body is the first.
    Only a reset changes a body: a ``design`` in the input of a step is not read.

    Falling does not end an episode. It is *truncated* after ``episode_steps`` steps. A row is *terminated* only if its
    simulation breaks (see :meth:`~coim.envs.simulation.Simulations.step`): it then hands out its last finite
    observation, ``num_broken`` counts it, and its robot stands at its start until the row is reset. No other row
    notices.

    The pitch is wrapped to (-pi, pi], in the observation and in the rewards: its hinge is unbounded and a fallen robot
    may roll on. Velocities are not clipped, as Gymnasium's walker and hopper do at 10.

    Keyword Args:
        num_runs: rows K of the fleet, the environment's batch size ``[K]``.
        task: ``"forward"``, or ``"backward"`` with the sign of the speed turned (Fig. 1, second row).
        episode_steps: steps after which an episode is truncated (1000 in Sec. 6.1).
        reset_noise: spread of the start state, in m, rad, m/s and rad/s; Gymnasium's by default, 0 for the bare start.
        seed: of the reset noise; every row has a generator of its own, derived from (seed, row). Drawn from torch if
            unset.
        num_threads: native threads that share the rows. They do not change the results.
        device: where the tensors go. The simulations themselves run on the CPU.

    Attributes:
        simulations: the native fleet: live positions, velocities and compiled bodies, for whoever looks beneath.
        num_broken: how often each row's simulation broke so far, ``[K]`` int64.

    Raises:
        ValueError: an argument is out of range, the device is not there, or the names of the design's entries do not
            fit it.
    """

    ASSET: ClassVar[str]  # XML file in assets/, or an absolute path
    DESIGN_SIZE: ClassVar[int]
    DESIGN_NAMES: ClassVar[tuple[str, ...]] = ()  # of the design's entries; see design_names()
    DESIGN_BOUNDS: ClassVar[tuple[float, float]]
    FRAME_SKIP: ClassVar[int]  # simulation steps in an environment step
    RESET_NOISE: ClassVar[float]
    OBSERVATION_SCALE: ClassVar[tuple[float, ...]]  # standard deviations under random actions at xi = 1, rounded
    FIRST_DESIGNS: ClassVar[tuple[tuple[float, ...], ...]]  # that a recipe's run tries first

    _first_position = 1  # of qpos in the observation: the root's x is left out

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
    ) -> None:
        for name, count in (("num_runs", num_runs), ("episode_steps", episode_steps), ("num_threads", num_threads)):
            if isinstance(count, bool) or not isinstance(count, int) or count < 1:
                raise ValueError(f"{name} {count!r} is not a whole number of at least 1")
        self.design_names()
        speed_along(task, torch.zeros(1))
        self.task, self.episode_steps = task, episode_steps
        self.reset_noise = self.RESET_NOISE if reset_noise is None else reset_noise
        if not 0 <= self.reset_noise < math.inf:
            raise ValueError(f"reset_noise {reset_noise} is not a finite number of at least 0; 0 gives the bare start")
        super().__init__(device=_existing(device), batch_size=torch.Size([num_runs]))
        self._design = torch.ones(num_runs, self.DESIGN_SIZE)
        self.simulations = Simulations(
            mujoco.MjSpec.from_file(str(Path(__file__).parent / "assets" / self.ASSET)),
            shape_body=self.shape_body,
            designs=self._design.numpy(),
            num_threads=num_threads,
        )
        self._observation = self._see()
        self._step_count = torch.zeros(num_runs, 1, dtype=torch.int64)
        self.num_broken = torch.zeros(num_runs, dtype=torch.int64)
        self._make_specs()
        self.set_seed(int(torch.randint(2**31, ())) if seed is None else seed)

    @abstractmethod
    def shape_body(self, spec: mujoco.MjSpec, design: np.ndarray) -> None:
        """Turn the body as drawn into the body of a design, in place.

        Args:
            spec: the body as drawn, xi = 1.
            design: scale factors within the bounds, ``[D]`` float64.
        """

    @staticmethod
    @abstractmethod
    def reward(
        observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor, task: Task = "forward"
    ) -> Tensor:
        """The reward, a pure function that the world and the dream share (the reward is known: Sec. 3).

        Args:
            observation: ``[*B, S]``.
            action: ``[*B, A]`` in [-1, 1].
            next_observation: ``[*B, S]``.
            design: ``[*B, D]``.
            task: ``"forward"`` or ``"backward"``.

        Returns:
            ``[*B, 1]``.
        """

    @classmethod
    def design_names(cls) -> tuple[str, ...]:
        """Names of the D entries of a design, ``DESIGN_NAMES``, or ``design 0, design 1, ...`` of a body without them.

        Raises:
            ValueError: they are not D different names of letters and digits; words may have spaces between them.
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

    def draw_noise(self, num_positions: int, num_velocities: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Reset noise of one row for ``reset_noise=1``: uniform in [-1, 1], positions and velocities, float64."""
        noise = 2 * torch.rand(num_positions + num_velocities, generator=generator, dtype=torch.float64) - 1
        return noise[:num_positions], noise[num_positions:]

    @property
    def reward_fn(self) -> Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]:
        """:meth:`reward` of this environment's task, for the dream: (observation, action, next observation, design)."""
        return functools.partial(type(self).reward, task=self.task)

    @property
    def design_spec(self) -> Bounded:
        """The designs that can be built, ``[D]``: ``project`` clips to them, ``rand`` draws from them."""
        low, high = self.DESIGN_BOUNDS
        return Bounded(low, high, shape=(self.DESIGN_SIZE,), dtype=torch.float32, device=self.device)

    @property
    def observation_scale(self) -> Tensor:
        """Typical spread of each observation, ``[S]``: networks divide by it."""
        scale = self.OBSERVATION_SCALE[-self.observation_spec["observation"].shape[-1] :]  # without root x: the rest
        return torch.tensor(scale, device=self.device)

    @property
    def angle_indices(self) -> tuple[int, ...]:
        """Entries of the observation that are angles wrapped to (-pi, pi]."""
        return (PITCH - self._first_position,)

    def advance(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Step the fleet on tensors: :meth:`step` without its tensordicts, many times faster for few rows.

        Args:
            action: motor torques as shares of the motors' strength, ``[K, A]``; MuJoCo clips them to [-1, 1].

        Returns:
            Next observation ``[K, S]``, reward ``[K, 1]`` and whether the simulation broke ``[K, 1]``.

        Raises:
            ValueError: the action has another shape or a number that is not finite; nothing has moved then.
        """
        before = self._observation
        observation, terminated = self.move(action)
        reward = self.reward(before, action.detach().cpu(), self._observation, self._design, self.task)
        return observation, self._send(reward), terminated

    def move(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """:meth:`advance` without the reward, which :meth:`reward` gives for a whole episode at once.

        Args:
            action: ``[K, A]``.

        Returns:
            Next observation ``[K, S]`` and whether the simulation broke ``[K, 1]``.

        Raises:
            ValueError: as :meth:`advance`.
        """
        action = action.detach().cpu()
        if action.shape != self.simulations.ctrl.shape:
            raise ValueError(f"action has shape {list(action.shape)}, the fleet takes {list(self.action_spec.shape)}")
        torques = action.numpy()
        if not math.isfinite(torques.sum()):
            raise ValueError(f"action {action.tolist()} is not finite; the policy that gave it has diverged")
        self.simulations.ctrl[:] = torques
        broken = self.simulations.step(self.FRAME_SKIP)
        observation = self._see()
        terminated = torch.zeros(len(action), 1, dtype=torch.bool)
        if broken.size:
            observation[broken] = self._observation[broken]
            terminated[broken] = True
            self.num_broken[broken] += 1
        self._observation = observation.clone()  # ours; what is handed out may be written to
        self._step_count += 1
        return self._send(observation), self._send(terminated)

    def place(self, observation: Tensor, design: Tensor) -> None:
        """Set all simulations to a state and a body each, to compare a learnt model with the truth.

        Args:
            observation: ``[K, S]``; a root x that it does not hold becomes 0.
            design: ``[K, D]``.

        Raises:
            ValueError: a wrong shape, a number that is not finite, or a design out of bounds.

        Note:
            The solver's warm start is no part of an observation: the next step agrees with the one that was once seen
            from here to the precision of float32, not to the last bit.
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

    def get_simulation_state(self) -> TensorDict:
        """All that the coming steps and resets depend on, ``[K]``: bodies, simulations, generators, counters.

        Rows of it may be loaded into another fleet, which goes on as these rows would have, to the last bit.
        """
        state = {
            "design": self._design,
            "observation": self._observation,
            "simulation": torch.from_numpy(self.simulations.state),
            "generator": torch.stack([generator.get_state() for generator in self._generators]),
            "step_count": self._step_count,
            "num_broken": self.num_broken,
        }
        return TensorDict(state, self.batch_size).clone()

    def set_simulation_state(self, state: TensorDictBase) -> None:
        """Go on from where :meth:`get_simulation_state` was called.

        Raises:
            ValueError: the state is one of another number of runs.
        """
        if state.batch_size != self.batch_size:
            raise ValueError(
                f"the state holds {state.numel()} runs, this fleet has {self.numel()}; index it to select some"
            )
        state = state.clone().cpu()
        self._build(state["design"], np.arange(self.numel()))
        self.simulations.state[:] = state["simulation"].numpy()
        for generator, generator_state in zip(self._generators, state["generator"]):
            restore_generator(generator, generator_state)
        self._observation, self._step_count, self.num_broken = (
            state[key] for key in ("observation", "step_count", "num_broken")
        )

    def capsules(self, run: int = 0) -> Tensor:
        """Outline of one row as it stands, ``[segments, 5]``: x and z of both ends and the radius, in m."""
        return torch.from_numpy(self.simulations.capsules(run))

    def render(self, run: int = 0, *, width: int = 480, height: int = 360) -> np.ndarray:
        """A picture of one row as it stands, ``[height, width, 3]`` uint8, about 0.1 s without a graphics card.

        Raises:
            RuntimeError: there is no OpenGL; the sentence says what to set and install.
        """
        with self.camera(run, width=width, height=height) as camera:
            return camera.photograph(self.simulations.qpos[run])

    def camera(self, run: int = 0, *, width: int = 480, height: int = 360) -> Camera:
        """A camera for many pictures of one row's present body, from any ``simulations.qpos``; see :meth:`render`."""
        return Camera(self.simulations.body(self._design[run].numpy()), width=width, height=height)

    @property
    def step_seconds(self) -> float:
        """What a step takes in the simulated world, in s."""
        return self.FRAME_SKIP * self.simulations.model(0).opt.timestep

    def _make_specs(self) -> None:
        shape, device = self.batch_size, self.device
        design = self.design_spec.expand(*shape, self.DESIGN_SIZE)
        observation = Unbounded(self._observation.shape, dtype=torch.float32, device=device)
        self.observation_spec = Composite(observation=observation, design=design.clone(), shape=shape, device=device)
        # In the state spec too: from the observation spec alone, TransformedEnv.reset drops the design without a word.
        self.state_spec = Composite(design=design.clone(), shape=shape, device=device)
        self.action_spec = Bounded(-1, 1, shape=self.simulations.ctrl.shape, dtype=torch.float32, device=device)
        self.reward_spec = Unbounded((*shape, 1), dtype=torch.float32, device=device)
        flags = {key: Binary(1, (*shape, 1), dtype=torch.bool, device=device) for key in DONE_KEYS}
        self.done_spec = Composite(flags, shape=shape, device=device)

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            return
        words = [np.random.SeedSequence([seed, row]).generate_state(1, np.uint32)[0] for row in range(self.numel())]
        self._generators = [torch.Generator().manual_seed(int(word)) for word in words]

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        given = TensorDict() if tensordict is None else tensordict
        chosen, design = given.get("_reset", None), given.get("design", None)
        rows = np.arange(self.numel()) if chosen is None else np.flatnonzero(chosen.cpu().numpy())
        if design is not None:
            self._build(design, rows)
        self._start(rows)
        values = {"observation": self._send(self._observation), "design": self._send(self._design)}
        if chosen is not None:
            # For rows that are not reset TorchRL answers with the caller's values, and with zeros if there are none.
            given.update({key: value.clone() for key, value in values.items()})
        flags = {key: torch.zeros(self.numel(), 1, dtype=torch.bool) for key in DONE_KEYS}
        return TensorDict(values | flags, self.batch_size, device=self.device).clone()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation, reward, terminated = self.advance(tensordict.get("action"))
        truncated = self._send(self._step_count >= self.episode_steps)
        values = {
            "observation": observation,
            "design": self._send(self._design.clone()),
            "reward": reward,
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
        }
        return TensorDict(values, self.batch_size, device=self.device)

    def _build(self, design: Tensor, rows: np.ndarray) -> None:
        """Check the designs of the given rows, ``design [K, D]``, and build those that are new."""
        if design.shape != self._design.shape:
            raise ValueError(f"design has shape {list(design.shape)}, this fleet takes {list(self._design.shape)}")
        wanted = design.detach().to("cpu", torch.float32)[rows]
        low, high = torch.tensor(self.DESIGN_BOUNDS)
        if not bool(((wanted >= low) & (wanted <= high)).all()):  # NaN is neither
            raise ValueError(
                f"design {wanted.tolist()} leaves [{low:.4g}, {high:.4g}]; clip it with design_spec.project()"
            )
        changed = (wanted != self._design[rows]).any(-1).numpy()
        if changed.any():
            self.simulations.build(rows[changed], wanted[changed].numpy())
            self._design[rows] = wanted

    def _start(self, rows: np.ndarray) -> None:
        """Begin new episodes: the start pose of each body, noise from the row's own generator, no foot in the floor."""
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
        """The observation ``[K, S]`` of the simulations as they stand: ``qpos, qvel`` with the pitch wrapped."""
        state = np.concatenate((self.simulations.qpos[:, self._first_position :], self.simulations.qvel), axis=1)
        pitch = state[:, PITCH - self._first_position]
        pitch -= math.tau * np.ceil(pitch / math.tau - 0.5)  # wrap_angle, before precision is lost to float32
        return torch.from_numpy(state.astype(np.float32))

    def _send(self, tensor: Tensor) -> Tensor:
        """Move a tensor from where the simulations run to the environment's device."""
        return tensor if self.device is None or self.device.type == "cpu" else tensor.to(self.device)


def _existing(device: torch.device | str | None) -> torch.device | None:
    """The device, if this machine has it."""
    if device is None:
        return None
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"device {str(device)!r} is not there ({reason}); 'cpu' always is") from error
    return torch.device(device)
