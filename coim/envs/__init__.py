"""Robots whose bodies are set by a design, as TorchRL environments."""

import os

try:
    import mujoco  # noqa: F401
except AttributeError as error:  # PyOpenGL's way to say that the library which MUJOCO_GL names is not installed
    raise ImportError(
        f"MUJOCO_GL={os.environ.get('MUJOCO_GL')} names an OpenGL library that is missing: unset MUJOCO_GL, or install "
        "the library (Debian: apt-get install libegl1 libegl-mesa0 for egl, libosmesa6 for osmesa)"
    ) from error

from coim.envs.half_cheetah import HalfCheetahMorph
from coim.envs.hopper import HopperMorph
from coim.envs.morph import MorphEnv
from coim.envs.simulator_dream import SimulatorDynamics
from coim.envs.walker import WalkerMorph
from coim.envs.world_model import WorldModelEnv

# By the names of their recipes, which stand in a run's config.json.
BODIES: dict[str, type[MorphEnv]] = {"half_cheetah": HalfCheetahMorph, "hopper": HopperMorph, "walker": WalkerMorph}

__all__ = ["BODIES", "HalfCheetahMorph", "HopperMorph", "MorphEnv", "SimulatorDynamics", "WalkerMorph", "WorldModelEnv"]
