"""Robots whose bodies are set by a design, as TorchRL environments."""

from coim.envs.half_cheetah import HalfCheetahMorph
from coim.envs.hopper import HopperMorph
from coim.envs.morph import MorphEnv
from coim.envs.walker import WalkerMorph
from coim.envs.world_model import WorldModelEnv

__all__ = ["HalfCheetahMorph", "HopperMorph", "MorphEnv", "WalkerMorph", "WorldModelEnv"]
