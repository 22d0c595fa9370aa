"""Names of the bodies in Gymnasium's registry, such as ``coim/Hopper-v0``."""

from __future__ import annotations

from collections.abc import Sequence

EPISODE_STEPS = 1000  # Sec. 6.1; gymnasium.make(..., max_episode_steps=...) takes another number
SUFFIX = "Morph"


def register_bodies(classes: Sequence[str]) -> None:
    """Make bodies known to ``gymnasium.make``, without importing them.

    Args:
        classes: names that `coim.envs` has; those of bodies end with ``Morph``: ``HopperMorph`` is ``coim/Hopper-v0``.
    """
    from gymnasium.envs.registration import register, registry

    for name in classes:
        called = f"coim/{name.removesuffix(SUFFIX)}-v0"
        if name.endswith(SUFFIX) and called not in registry:
            register(
                called,
                entry_point="coim.envs.gymnasium_env:GymnasiumEnv",
                max_episode_steps=EPISODE_STEPS,
                kwargs={"body": name},
            )
