"""A body class from an MJCF file and a list of what scales.

Shapes: *B any batch, S observation, D design, A action.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import cast

import mujoco
import numpy as np
import torch
from torch import Tensor

from coim.envs.morph import MorphEnv
from coim.envs.root import give_floor, read_root
from coim.envs.segments import Scale, keep_densities

STEP = 0.02  # s, about what a step takes by default
SEEN = (4, 100)  # robots and random steps from which the spread of the observations is measured
OTHERS = 4  # fixed draws among the first designs


def morph_from_mjcf(
    file: str | Path,
    scale: Scale,
    reward: Callable[..., Tensor],
    *,
    bounds: tuple[float, float] | Mapping[str, tuple[float, float]] = (0.5, 2.0),
    name: str | None = None,
    frame_skip: int | None = None,
    reset_noise: float = 0.01,
    camera: str | None = None,
) -> type[MorphEnv]:
    """Make a body class of a robot that is drawn in a file: a design scales lengths of its segments.

    The robot runs in a plane, moves freely, or stands on a fixed base (`coim.envs.root`); what a length moves is in
    `coim.envs.segments`. Its actuators are motors; an action of -1 or 1 is an end of a motor's ``ctrlrange``. The first
    designs are the robot as drawn and four fixed draws. The spread of the observations, by which networks divide, is
    measured on random actions and rounded.

    Args:
        file: MJCF file. One without a plane gets a floor at z = 0, if the robot moves.
        scale: for each entry of a design its name, and the names of the capsules whose length it scales.
        reward: ``(observation [*B, S], action [*B, A], next_observation [*B, S], design [*B, D]) -> [*B, 1]``, a pure
            torch function. With a fifth parameter ``task`` it is told ``"forward"`` or ``"backward"``.
        bounds: lowest and highest factor, for all entries or for each by its name.
        name: name of the class; by default that of the file's model. A class that is to be pickled, or to be named as
            ``module:Class``, is assigned to a variable of this name in a module.
        frame_skip: simulation steps in a step; by default about 0.02 s of them.
        reset_noise: spread of the start state, in m, rad, m/s and rad/s.
        camera: a camera of the file for pictures; by default its first one, or one that follows the robot.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if a name in ``scale`` is no capsule of the robot, ``bounds`` leave out an entry, or the robot is
            none that `coim.envs.root` knows; the message names it and the way out.

    Example:
        >>> from coim.envs import fleet
        >>> asset = Path(fleet.__file__).parent / "assets" / "half_cheetah.xml"
        >>> Cheetah = morph_from_mjcf(
        ...     asset,
        ...     scale={"back leg": ["bthigh", "bshin"], "front leg": ["fthigh", "fshin"]},
        ...     reward=lambda observation, action, next_observation, design: next_observation[..., 8, None],
        ...     bounds={"back leg": (0.8, 2.0), "front leg": (0.5, 1.5)},
        ...     name="Cheetah",
        ... )
        >>> Cheetah(num_runs=2, seed=0).rollout(3)["next", "reward"].shape
        torch.Size([2, 3, 1])
    """
    path = Path(file).resolve()
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}; give the path of an MJCF file")
    if not scale:
        raise ValueError("scale is empty; name what a design scales, as in {'left thigh': ['left_thigh_geom']}")
    drawn = mujoco.MjSpec.from_file(str(path))
    keep_densities(drawn)
    give_floor(drawn)
    model = drawn.compile()
    name = name or "".join(word.capitalize() for word in re.findall(r"[^\W_]+", drawn.modelname)) or "Robot"
    unseen = read_root(model, name).unseen
    module = sys._getframe(1).f_globals.get("__name__", __name__)
    pairs = _pairs(scale, bounds)
    constants = {
        "__doc__": f"The robot of {path.name}; a design scales {', '.join(scale)}.",
        "__module__": module,
        "ASSET": str(path),
        "SCALE": {entry: names if isinstance(names, str) else tuple(names) for entry, names in scale.items()},
        "DESIGN_SIZE": len(scale),
        "DESIGN_NAMES": tuple(scale),
        "DESIGN_BOUNDS": pairs,
        "FRAME_SKIP": max(1, round(STEP / model.opt.timestep)) if frame_skip is None else frame_skip,
        "RESET_NOISE": reset_noise,
        "FIRST_DESIGNS": _first_designs(pairs),
        "OBSERVATION_SCALE": (1.0,) * (model.nq - unseen + model.nv),
        "CAMERA": camera,
        "reward": staticmethod(_told(reward, name, module)),
    }
    body = cast("type[MorphEnv]", type(name, (MorphEnv,), constants))
    body.OBSERVATION_SCALE = measured_spread(body)
    return body


def measured_spread(body: type[MorphEnv]) -> tuple[float, ...]:
    """Measure the standard deviation of each observation under random actions at xi = 1, to one digit, ``S`` numbers.

    Example:
        >>> from coim import HopperMorph
        >>> len(measured_spread(HopperMorph))
        11
    """
    rows, steps = SEEN
    env, generator = body(num_runs=rows, seed=0), torch.Generator("cpu").manual_seed(0)
    env.reset()
    actions = 2 * torch.rand(steps, *env.simulations.ctrl.shape, generator=generator, dtype=torch.float32) - 1
    spread = torch.stack([env.move(action)[0] for action in actions]).std((0, 1))
    return tuple(float(f"{value:.1g}") if value > 0 else 1.0 for value in spread.tolist())


def _pairs(
    scale: Scale, bounds: tuple[float, float] | Mapping[str, tuple[float, float]]
) -> tuple[tuple[float, float], ...]:
    """Return the bounds of each entry, in the order of the design."""
    if not isinstance(bounds, Mapping):
        return (bounds,) * len(scale)
    if bounds.keys() != scale.keys():
        raise ValueError(f"bounds are those of {list(bounds)}, and a design has {list(scale)}; give a pair for each")
    return tuple(bounds[entry] for entry in scale)


def _first_designs(pairs: tuple[tuple[float, float], ...]) -> tuple[tuple[float, ...], ...]:
    """Return the robot as drawn and fixed draws from the uniform distribution, to two digits behind the point."""
    low, high = np.sort(pairs, axis=1).T  # a pair the wrong way round is refused with all other bounds
    drawn = np.random.default_rng(0).uniform(low, high, (OTHERS, len(pairs))).round(2).clip(low, high)
    return ((1.0,) * len(pairs), *(tuple(row) for row in drawn.tolist()))


def _told(reward: Callable[..., Tensor], name: str, module: str) -> Callable[..., Tensor]:
    """Return a reward with the parameter ``task``; one that has none serves the task forward alone."""
    if "task" in inspect.signature(reward).parameters:
        return reward

    def told(
        observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor, task: str = "forward"
    ) -> Tensor:
        if task != "forward":
            raise ValueError(f"the reward of {name} knows no task {task!r}; give it a fifth parameter, task")
        return reward(observation, action, next_observation, design)

    told.__qualname__, told.__module__ = f"{name}.reward", module  # where pickle finds it
    return told
