"""A body as a Gymnasium environment: ``gymnasium.make("coim/Hopper-v0", design=[...])``.

Shapes: S observation, D design, A action.

References:
    Towers et al.: Gymnasium, a standard interface for reinforcement learning environments,
    https://gymnasium.farama.org.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, cast

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from coim.envs.bodies import BODIES
from coim.envs.camera import Camera
from coim.envs.morph import MorphEnv
from coim.envs.simulation import BEYOND_PHYSICS
from coim.envs.task import Task
from coim.envs.window import Window, refuse_without_display

Design = Sequence[float] | NDArray[np.floating] | Literal["random"]
Numbers = NDArray[np.float32]
MODES = ("human", "rgb_array")
LARGEST_SEED = 2**31


class GymnasiumEnv(gymnasium.Env[Numbers, Numbers]):
    """One body in Gymnasium's interface, with the physics and the reward of its :class:`~coim.envs.morph.MorphEnv`.

    ``gymnasium.make("coim/Hopper-v0")`` makes it after ``import coim``, and so it does ``coim/HalfCheetah-v0`` and all
    other bodies; a body of your own is ``GymnasiumEnv(MyBody)``. ``make`` truncates an episode after 1000 steps, or
    ``max_episode_steps``. An episode is terminated only if its simulation breaks; a fall does not end it.

    ===========  ======================================================================================
    space        entries
    ===========  ======================================================================================
    observation  those of the body, see its class; then the D entries of its design; float32
    action       shares of the motors' torques in [-1, 1], ``[A]`` float32
    ===========  ======================================================================================

    The info of a reset has the ``design``, ``[D]`` float32. Angles are in [-pi, pi], all other quantities within 1e6:
    a simulation beyond is broken. ``metadata["render_fps"]`` is the number of steps in a second of simulated time.

    Args:
        body: its class, or the name of the class of one of ours, such as ``"HopperMorph"``.
        design: the body at first, ``[D]`` factors of its lengths; "random" draws one uniformly at each reset. None is
            the body as drawn, 1 for each entry.
        observe_design: whether observations end with the design, as a policy for many bodies needs it.
        task: ``"forward"``, or ``"backward"`` with the opposite sign of the speed.
        reset_noise: spread of the start state in m, rad, m/s and rad/s; that of the body by default, 0 for none.
        render_mode: ``"rgb_array"`` draws without a screen, ``"human"`` shows a window in real time, None nothing.
        width: pixels of a picture of ``"rgb_array"``.
        height: likewise.

    Raises:
        ValueError: if the design leaves its bounds or has another length, or a name is not known.
        RuntimeError: if ``"human"`` has no display, or ``"rgb_array"`` no OpenGL (from its first picture on).

    Example:
        >>> import coim, gymnasium
        >>> env = gymnasium.make("coim/Hopper-v0", design=[1.0, 1.5, 0.5, 1.0], max_episode_steps=100)
        >>> observation, info = env.reset(seed=0)
        >>> observation.shape, info["design"].tolist()
        ((15,), [1.0, 1.5, 0.5, 1.0])
        >>> _, info = env.reset(options={"design": [1.0, 1.0, 0.5, 2.0]})  # the body from now on
        >>> info["design"].tolist()
        [1.0, 1.0, 0.5, 2.0]
    """

    metadata: dict[str, Any] = {"render_modes": list(MODES)}  # noqa: RUF012  (as gymnasium.Env declares it)

    def __init__(
        self,
        body: type[MorphEnv] | str,
        *,
        design: Design | None = None,
        observe_design: bool = True,
        task: Task = "forward",
        reset_noise: float | None = None,
        render_mode: Literal["human", "rgb_array"] | None = None,
        width: int = 480,
        height: int = 360,
    ) -> None:
        if render_mode not in (None, *MODES):
            raise ValueError(f"render_mode is {render_mode!r}, it must be one of {', '.join(MODES)}, or None")
        if render_mode == "human":
            refuse_without_display()
        kind = body_class(body)
        self.bodies = kind(
            task=task, reset_noise=reset_noise, seed=int(self.np_random.integers(LARGEST_SEED)), device="cpu"
        )
        self.render_mode, self._size = render_mode, (width, height)
        self.metadata = {**self.metadata, "render_fps": round(1 / self.bodies.step_seconds)}
        self._observe_design = observe_design
        self._shown: Camera | Window | None = None  # of the present body
        self._design = np.ones(kind.DESIGN_SIZE, np.float32)
        self._draws = isinstance(design, str)
        if design is not None:
            self._design = self._chosen(design)
        shares = np.ones(self.bodies.action_spec.shape[-1], np.float32)
        self.action_space = cast(gymnasium.Space[Numbers], Box(-shares, shares))
        self.observation_space = cast(gymnasium.Space[Numbers], self._bounds())

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Numbers, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: of the start states and random bodies from this episode on; the start is that of
                ``MorphEnv(seed=seed)``. None goes on with the random numbers that there are.
            options: ``{"design": [...]}`` builds a body, which stays until another is built; ``{"design": "random"}``
                draws it.

        Returns:
            The first observation, and the info with the ``design``.

        Raises:
            ValueError: if a design leaves its bounds or has another length, or there are other options.
        """
        super().reset(seed=seed)
        asked = dict(options or {})
        design = asked.pop("design", "random" if self._draws else None)
        if asked:
            raise ValueError(f"options has {', '.join(map(repr, asked))}; the only option of a reset is 'design'")
        if design is not None:
            self._build(self._chosen(design))
        if seed is not None:
            self.bodies.set_seed(seed)
        start = self.bodies.reset(TensorDict({"design": torch.from_numpy(self._design)[None]}, [1]))
        self._show()
        return self._seen(start["observation"]), {"design": self._design.copy()}

    def step(self, action: Numbers) -> tuple[Numbers, float, bool, bool, dict[str, Any]]:
        """Step the body.

        Args:
            action: ``[A]`` in [-1, 1]; what leaves the range is clipped.

        Returns:
            Observation, reward, whether the simulation broke, False (``gymnasium.make`` adds the time limit), and an
            empty info.

        Raises:
            ValueError: if the action has another shape, or a number that is not finite.
        """
        torques = torch.from_numpy(np.array(action, np.float32))[None]
        observation, reward, broken = self.bodies.advance(torques)
        self._show()
        return self._seen(observation), reward.item(), bool(broken), False, {}

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the body as it is: a picture ``[height, width, 3]`` with ``"rgb_array"``; otherwise None."""
        if self.render_mode != "rgb_array":
            return None
        if not isinstance(self._shown, Camera):
            self._shown = self.bodies.camera(width=self._size[0], height=self._size[1])
        return self._shown.photograph(self.bodies.simulations.qpos[0])

    def close(self) -> None:
        """Free what drew the body; more steps are possible."""
        if self._shown is not None:
            self._shown.close()
            self._shown = None

    def _show(self) -> None:
        """Show the present pose in a window, if there is to be one."""
        if self.render_mode != "human":
            return
        simulations = self.bodies.simulations
        if not isinstance(self._shown, Window):
            body = self.bodies.drawn_body(self._design)
            self._shown = Window(body, root=self.bodies.root, step_seconds=self.bodies.step_seconds)
        self._shown.show(simulations.qpos[0])

    def _chosen(self, design: Design) -> Numbers:
        """The design that is asked for, or a draw; checked, ``[D]``."""
        low, high = self._design_bounds()
        size = len(low)
        if isinstance(design, str):
            if design != "random":
                raise ValueError(f"design is {design!r}, it must be {size} numbers or 'random'")
            return self.np_random.uniform(low, high).astype(np.float32)
        chosen = np.array(design, np.float32)
        # NaN is not within.
        if chosen.shape != (size,) or not bool(((chosen >= low) & (chosen <= high)).all()):
            ranges = zip(self.bodies.design_names(), low, high)
            entries = ", ".join(f"{name} in [{least:g}, {most:g}]" for name, least, most in ranges)
            raise ValueError(f"design is {chosen.tolist()}, it must be {size} numbers: {entries}")
        return chosen

    def _build(self, design: Numbers) -> None:
        """Take a design for the coming reset; what drew another body is of no more use."""
        if (design != self._design).any():
            self.close()
        self._design = design

    def _seen(self, observation: Tensor) -> Numbers:
        """An observation ``[1, S]`` as the space has it, ``[S]`` or ``[S + D]``, of its own memory."""
        seen = observation[0].numpy()
        return np.concatenate([seen, self._design]) if self._observe_design else seen.copy()

    def _design_bounds(self) -> tuple[Numbers, Numbers]:
        """Lowest and highest factor of each entry, ``[D]`` each."""
        low, high = (end.float().numpy() for end in self.bodies.design_bounds())
        return low, high

    def _bounds(self) -> Box:
        """The space of observations."""
        size = self.bodies.observation_spec["observation"].shape[-1]
        limit = np.full(size, BEYOND_PHYSICS, np.float32)
        limit[list(self.bodies.angle_indices)] = math.pi
        if not self._observe_design:
            return Box(-limit, limit)
        low, high = self._design_bounds()
        return Box(np.concatenate([-limit, low]), np.concatenate([limit, high]))


def body_class(body: type[MorphEnv] | str) -> type[MorphEnv]:
    """The class of a body, by its name if it is a name.

    Raises:
        ValueError: if there is no such body.
    """
    ours = {kind.__name__: kind for kind in BODIES.values()}
    found = ours.get(body) if isinstance(body, str) else body
    if not (isinstance(found, type) and issubclass(found, MorphEnv)):
        raise ValueError(f"body is {body!r}, it must be a class derived from MorphEnv or one of {', '.join(ours)}")
    return found


def made_by_name(body: type[MorphEnv], **options: Any) -> GymnasiumEnv:
    """A body's environment that has a ``spec``, from which Gymnasium makes it again; one of another class has none.

    Args:
        body: its class.
        options: of `GymnasiumEnv`.
    """
    name = f"coim/{body.__name__.removesuffix('Morph')}-v0"
    if body not in BODIES.values():
        return GymnasiumEnv(body, **options)
    made = gymnasium.make(name, **options).unwrapped
    assert isinstance(made, GymnasiumEnv)
    return made
