"""A fleet of robots with designed bodies as a TorchRL environment: the base class of all bodies.

Shapes: K runs (rows of the fleet), S observation, D design, A action.

References:
    Co-Imagination of Behaviour & Morphology of Agents, Sec. 3 (the design as a context of the MDP) and Sec. 6.
    Towers et al.: Gymnasium, a standard interface for reinforcement learning environments,
    https://gymnasium.farama.org.
"""

from __future__ import annotations

import functools
import math
from abc import abstractmethod
from collections.abc import Callable
from numbers import Integral
from typing import Any, get_args

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded

from coim.envs.designed_env import (
    DesignedEnv,
    check_reset,
    check_reward,
    check_rewards,
    check_step,
    idle_rows,
    leave_idle,
)
from coim.envs.fleet import Fleet
from coim.envs.robot import Physics
from coim.envs.task import Task, speed_along

DONE_KEYS = ("done", "terminated", "truncated")


class MorphEnv(Fleet, DesignedEnv):
    """A fleet of robots; a design vector sets their bodies at reset.

    A new body is a subclass: an XML file, the constants of :class:`~coim.envs.robot.Robot`, what scales (``SCALE``, or
    :meth:`shape_body`) and :meth:`reward`; :func:`~coim.morph_from_mjcf` makes one without a class statement. The robot
    runs in the plane of x and z, moves freely, or stands on a fixed base (see `coim.envs.root`); its actuators are
    motors, and an action of -1 or 1 is an end of a motor's ``ctrlrange``.

    The input of a reset sets the design: ``env.reset(TensorDict({"design": xi}, [K]))``. It stays until a reset gives
    another one: auto-resets, partial resets and resets without ``design`` keep it. The first body has xi = 1. Only a
    reset changes a body: a step with another ``design`` in its input is refused. To draw a body for each episode of a
    collector, let a transform write it before the reset::

        draw = TensorDictPrimer(env.state_spec, random=True, call_before_env_reset=True)
        Collector(TransformedEnv(env, draw), policy, frames_per_batch=1000)

    A fall does not end an episode. The episode is *truncated* after ``episode_steps`` steps. A row is *terminated* only
    if its simulation breaks (see :meth:`~coim.envs.simulation.Simulations.step`). It then returns its last finite
    observation, ``num_broken`` counts it, and its robot stays at its start until the row is reset. Other rows are not
    affected.

    An observation is ``qpos, qvel`` without the robot's place on the ground. Hinges without limits are wrapped to
    (-pi, pi], such as the pitch of a planar robot: a fallen one can roll over. A free root has its orientation as
    MuJoCo's unit quaternion (w, x, y, z), whose sign is not fixed: it changes continuously, while a fixed sign would
    jump where robots lie on their backs. Velocities are not clipped; Gymnasium's walker and hopper clip them at 10.

    Keyword Args:
        num_runs: rows K of the fleet, the environment's batch size ``[K]``.
        task: ``"forward"``, or ``"backward"`` with the opposite sign of the speed (Fig. 1, second row).
        episode_steps: steps after which an episode is truncated (1000 in Sec. 6.1).
        reset_noise: spread of the start state, in m, rad, m/s and rad/s; Gymnasium's by default, 0 for no noise.
        seed: seed of the reset noise; each row has its own generator, derived from (seed, row). Drawn from torch's
            global generator if None.
        num_threads: native threads that share the rows. They do not change the results.
        device: device of the tensors, torch's default device if None.
        physics: ``mujoco`` computes on the CPU in float64, and gives the same bits each time. ``warp`` is MuJoCo Warp:
            the device steps all bodies at once, in float32, and **not bit for bit the same** the next time; episodes
            are never native with it. It needs ``pip install 'coim[warp]'``.

    Attributes:
        simulations: the simulations themselves: live positions and velocities, and the compiled bodies.
        num_broken: how often the simulation of each row has broken, ``[K]`` int64.

    Raises:
        ValueError: if an argument is out of range, the device does not exist, the names or bounds of the design or the
            scale of the observation do not fit, the body is none that `coim.envs.root` knows, or the reward is not
            ``[*B, 1]``.
        ImportError: if MuJoCo Warp is asked for and not installed.
        NotImplementedError: if MuJoCo Warp does not know a part of the body.

    Example:
        >>> from coim import HopperMorph
        >>> bodies = HopperMorph(num_runs=2, seed=0)
        >>> longer = torch.tensor([[1.0, 1.0, 1.0, 1.0], [1.0, 1.5, 1.5, 1.0]])  # torso, thigh, shank, foot
        >>> rows = bodies.reset(TensorDict({"design": longer}, [2]))
        >>> bool(rows["observation"][1, 0] > rows["observation"][0, 0])  # its torso stands higher, in m
        True
    """

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
    ) -> None:
        if physics not in get_args(Physics):
            raise ValueError(f"physics {physics!r} is neither 'mujoco' nor 'warp'")
        for name, count in (("num_runs", num_runs), ("episode_steps", episode_steps), ("num_threads", num_threads)):
            if isinstance(count, bool) or not isinstance(count, Integral) or count < 1:
                raise ValueError(f"{name} {count!r} is not a whole number of at least 1")
        self.design_names()
        self._check_bounds()
        speed_along(task, torch.zeros(1, device="cpu"))
        self.task, self.episode_steps = task, episode_steps
        self.reset_noise = self.RESET_NOISE if reset_noise is None else reset_noise
        if not 0 <= self.reset_noise < math.inf:
            raise ValueError(
                f"reset_noise {self.reset_noise} is not a finite number of at least 0; 0 gives a start without noise"
            )
        super().__init__(device=_existing(device), batch_size=torch.Size([num_runs]))
        self._begin(num_runs, num_threads=num_threads, physics=physics, device=str(self.device or "cpu"))
        self._make_specs()
        self._check_numbers()
        self.set_seed(int(torch.randint(2**31, (), device="cpu")) if seed is None else seed)

    @staticmethod
    @abstractmethod
    def reward(
        observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor, task: Task = "forward"
    ) -> Tensor:
        """The reward: a pure function, used by the real bodies and the dream (the reward is known: Sec. 3).

        Args:
            observation: ``[*B, S]``.
            action: ``[*B, A]`` in [-1, 1].
            next_observation: ``[*B, S]``.
            design: ``[*B, D]``.
            task: ``"forward"`` or ``"backward"``.

        Returns:
            ``[*B, 1]``.
        """

    @property
    def reward_fn(self) -> Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]:
        """:meth:`reward` of this environment's task, for the dream: (observation, action, next observation, design)."""
        return functools.partial(type(self).reward, task=self.task)

    @property
    def design_spec(self) -> Bounded:
        """The designs that can be built, ``[D]``: ``project`` clips to them, ``rand`` draws from them."""
        low, high = (bound.to(self.device, torch.float32) for bound in self.design_bounds())
        return Bounded(low, high, shape=(self.DESIGN_SIZE,), dtype=torch.float32, device=self.device)

    @property
    def observation_scale(self) -> Tensor:
        """Typical spread of each observation, ``[S]``; networks divide by it."""
        # The last entries: without the place on the ground if it is not observed.
        scale = self.OBSERVATION_SCALE[-self.observation_spec["observation"].shape[-1] :]
        return torch.tensor(scale, dtype=torch.float32, device=self.device)

    @property
    def angle_indices(self) -> tuple[int, ...]:
        """Indices of the observation's entries that are angles, wrapped to (-pi, pi]."""
        return tuple(entry - self.first_position for entry in self.root.angles)

    @property
    def quaternion_index(self) -> int | None:
        """Index of the first of the four entries of the observation that are a unit quaternion; None without one."""
        return None if self.root.quaternion is None else self.root.quaternion - self.first_position

    def advance(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Step the fleet with tensors: like :meth:`step`, without tensordicts, and many times faster for few rows.

        :meth:`move` does the same without the reward; :meth:`reward` computes those of a whole episode at once.

        Args:
            action: ``[K, A]``; -1 and 1 are the ends of each motor's ``ctrlrange``, to which MuJoCo clips.

        Returns:
            Next observation ``[K, S]``, reward ``[K, 1]`` and whether the simulation broke ``[K, 1]``, on the action's
            device.

        Raises:
            ValueError: if the action has another shape, or a number that is not finite; the bodies have not moved then.
                If a reward is not finite; they have moved.
        """
        before = self._observation
        observation, terminated = self.move(action)
        reward = self.reward(before, action.detach().cpu(), self._observation, self._design, self.task)
        check_rewards(reward, self._design, name=type(self).__name__)
        return observation, reward.to(action.device), terminated

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for pickle and deepcopy: a copy compiles the bodies again, and continues from it."""
        live = ("simulations", "_generators")
        state = {key: value for key, value in super().__getstate__().items() if key not in live}
        return state | {"simulation_state": self.get_simulation_state()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        simulation_state = state.pop("simulation_state")
        super().__setstate__(state)
        self.simulations = self._simulate(self._design.numpy(), **self._simulated)
        self._seed_rows(0)  # makes the generators; set_simulation_state restores their states
        self.set_simulation_state(simulation_state)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._seed_rows(seed)

    def _make_specs(self) -> None:
        shape, device = self.batch_size, self.device
        design = self.design_spec.expand(*shape, self.DESIGN_SIZE)
        observation = Unbounded(self._observation.shape, dtype=torch.float32, device=device)
        self.observation_spec = Composite(observation=observation, design=design.clone(), shape=shape, device=device)
        # In the state spec too: with the observation spec only, TransformedEnv.reset silently drops the design.
        self.state_spec = Composite(design=design.clone(), shape=shape, device=device)
        self.action_spec = Bounded(-1, 1, shape=self.simulations.ctrl.shape, dtype=torch.float32, device=device)
        self.reward_spec = Unbounded((*shape, 1), dtype=torch.float32, device=device)
        flags = {key: Binary(1, (*shape, 1), dtype=torch.bool, device=device) for key in DONE_KEYS}
        self.done_spec = Composite(flags, shape=shape, device=device)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        check_reset(tensordict, ("design",), self._design.shape)
        given = TensorDict() if tensordict is None else tensordict
        chosen, design = given.get("_reset", None), given.get("design", None)
        rows = np.arange(self.numel()) if chosen is None else np.flatnonzero(chosen.cpu().numpy())
        if design is not None:
            self._build(design, rows)
        self._start(rows)
        values = {"observation": self._observation, "design": self._design}
        flags = {key: torch.zeros(self.numel(), 1, dtype=torch.bool, device="cpu") for key in DONE_KEYS}
        answer = self._answer(values | flags).clone()
        if chosen is not None:
            # For rows that are not reset, TorchRL returns the values of the input, and zeros if it has none.
            given.update(answer.select(*values).clone())
        return answer

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        given = tensordict
        if not self._on_host:  # one transfer to the CPU, and one back
            given = tensordict.select("action", "design", "_step", *DONE_KEYS, strict=False).to("cpu")
        check_step(given.get("design", None), self._design)
        idle = idle_rows(given, self.batch_size)
        with self.holding(idle):
            observation, reward, terminated = self.advance(given["action"])
        truncated = self._step_count >= self.episode_steps
        values = {
            "observation": observation,
            "design": self._design.clone(),
            "reward": reward,
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
        }
        if idle is not None:
            observation[idle] = self._observation[idle]
            leave_idle(values, given, idle)
        return self._answer(values)

    def _answer(self, values: dict[str, Tensor]) -> TensorDict:
        """Make a tensordict ``[K]`` of tensors on the CPU, and move it to the environment's device."""
        if self._on_host:
            return TensorDict(values, self.batch_size, device=self.device)
        return TensorDict(values, self.batch_size, device="cpu").to(self.device)

    @property
    def _on_host(self) -> bool:
        return self.device is None or self.device.type == "cpu"

    def _check_bounds(self) -> None:
        """Refuse bounds that are not factors of lengths."""
        try:
            pairs = list(zip(*(bound.tolist() for bound in self.design_bounds()), strict=True))
        except (RuntimeError, ValueError, TypeError):
            pairs = []
        if not pairs or not all(0 < low <= 1 <= high < math.inf and low < high for low, high in pairs):
            raise ValueError(
                f"{type(self).__name__}.DESIGN_BOUNDS is {self.DESIGN_BOUNDS}; it is one pair of factors of lengths, "
                f"or {self.DESIGN_SIZE} such pairs, each low < high, with 1 between them: the body as drawn, which is "
                "the first"
            )

    def _check_numbers(self) -> None:
        """Refuse a frame skip, an observation scale or a reward that do not fit the body."""
        name, size, scale = type(self).__name__, self._observation.shape[-1], self.OBSERVATION_SCALE
        if not isinstance(self.FRAME_SKIP, Integral) or self.FRAME_SKIP < 1:
            raise ValueError(f"{name}.FRAME_SKIP is {self.FRAME_SKIP}, not a whole number of at least 1")
        if len(scale) not in (size, size + self.first_position) or not all(0 < entry < math.inf for entry in scale):
            raise ValueError(
                f"{name}.OBSERVATION_SCALE is {scale}, not {size} positive numbers, one for each observed quantity"
            )
        torques = torch.zeros(self.action_spec.shape, dtype=torch.float32, device="cpu")
        check_reward(self.reward_fn, self._observation, torques, self._design, name=name)


def _existing(device: torch.device | str | None) -> torch.device | None:
    """Check that a device exists; for None, return torch's default device, or None if that is the CPU."""
    if device is None:
        default = torch.get_default_device()
        return None if default.type == "cpu" else default
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"device {str(device)!r} does not exist here ({reason}); 'cpu' always does") from error
    return torch.device(device)
