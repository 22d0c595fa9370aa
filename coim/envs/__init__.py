"""Robots with bodies that a design sets, as TorchRL environments."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from coim.lazy import lazy_names

try:
    import mujoco  # noqa: F401
except ModuleNotFoundError:
    pass  # the dream does not need mujoco; importing a body says that it is missing
except AttributeError as error:  # what PyOpenGL raises if the library of MUJOCO_GL is not installed
    raise ImportError(
        f"MUJOCO_GL={os.environ.get('MUJOCO_GL')} names an OpenGL library that is missing: unset MUJOCO_GL, or install "
        "the library (Debian: apt-get install libegl1 libegl-mesa0 for egl, libosmesa6 for osmesa)"
    ) from error

if TYPE_CHECKING:
    from .ant import AntMorph
    from .bodies import BODIES
    from .from_mjcf import morph_from_mjcf
    from .gymnasium_env import GymnasiumEnv
    from .half_cheetah import HalfCheetahMorph
    from .hopper import HopperMorph
    from .morph import MorphEnv
    from .simulator_dream import SimulatorDynamics
    from .walker import WalkerMorph
    from .world_model import WorldModelEnv
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "ant": ["AntMorph"],
            "bodies": ["BODIES"],
            "gymnasium_env": ["GymnasiumEnv"],
            "from_mjcf": ["morph_from_mjcf"],
            "half_cheetah": ["HalfCheetahMorph"],
            "hopper": ["HopperMorph"],
            "morph": ["MorphEnv"],
            "simulator_dream": ["SimulatorDynamics"],
            "walker": ["WalkerMorph"],
            "world_model": ["WorldModelEnv"],
        },
    )

__all__ = [
    "BODIES",
    "AntMorph",
    "GymnasiumEnv",
    "HalfCheetahMorph",
    "HopperMorph",
    "MorphEnv",
    "SimulatorDynamics",
    "WalkerMorph",
    "WorldModelEnv",
    "morph_from_mjcf",
]
