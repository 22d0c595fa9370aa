"""The bodies of this library by name, as in the ``config.json`` of a run."""

from __future__ import annotations

from coim.envs.ant import AntMorph
from coim.envs.half_cheetah import HalfCheetahMorph
from coim.envs.hopper import HopperMorph
from coim.envs.morph import MorphEnv
from coim.envs.walker import WalkerMorph

BODIES: dict[str, type[MorphEnv]] = {
    "half_cheetah": HalfCheetahMorph,
    "hopper": HopperMorph,
    "walker": WalkerMorph,
    "ant": AntMorph,
}
