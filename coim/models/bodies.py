"""Read from an environment what its networks need, also through transforms and batched environments.

Shapes: ``D`` design.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs import AsyncEnvPool, EnvBase, Transform, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase

from coim.randomness import GLOBAL_GENERATORS


def body_of(env: EnvBase) -> tuple[EnvBase, bool]:
    """Find the environment inside of transforms and of `SerialEnv`, `ParallelEnv` or `AsyncEnvPool`.

    Args:
        env: any environment; one without wrappers is returned as it is. To see the workers of a batched environment,
            another one of each is made; torch's global generator is not changed.

    Returns:
        The bare environment, and whether a transform rewrites its ``observation``.

    Raises:
        ValueError: if the workers have bodies of different classes, or only some of them have transforms.
    """
    if isinstance(env, TransformedEnv):
        body, rewritten = body_of(env.base_env)
        transforms = [part for part in env.transform.modules() if isinstance(part, Transform)]
        return body, rewritten or any("observation" in transform.out_keys for transform in transforms)
    if isinstance(env, BatchedEnvBase | AsyncEnvPool):
        with GLOBAL_GENERATORS, torch.random.fork_rng(devices=[]):
            workers = [body_of(worker) for worker in _workers(env)]
        kinds = {(type(body).__name__, "rewritten" if rewritten else "bare") for body, rewritten in workers}
        if len(kinds) > 1:
            raise ValueError(f"the workers have unlike bodies, {sorted(kinds)}; make the networks for one of them")
        return workers[0]
    return env, False


def _workers(env: BatchedEnvBase | AsyncEnvPool) -> list[EnvBase]:
    if isinstance(env, AsyncEnvPool):
        return [maker if isinstance(maker, EnvBase) else maker() for maker in env.env_makers]
    return [make(**given) for make, given in zip(env.create_env_fn, env.create_env_kwargs)]


def observed(env: EnvBase) -> TensorSpec:
    """Return the spec of ``observation`` as networks read it, after all transforms.

    Raises:
        ValueError: if there is no such entry, for example after a transform that renames it.
    """
    if "observation" not in env.observation_spec.keys():  # noqa: SIM118
        raise ValueError(
            f"the environment observes {[str(key) for key in env.observation_spec.keys()]}, and the networks read "  # noqa: SIM118
            "'observation': keep that name, with create_copy=True in a RenameTransform or del_keys=False in CatTensors"
        )
    return env.observation_spec["observation"]


def design_bounds(env: EnvBase) -> tuple[Tensor, Tensor, Tensor]:
    """Return the bounds of the design as networks read it, after all transforms.

    Args:
        env: has ``design`` in its ``observation_spec``, or has a ``design_spec``.

    Returns:
        Lowest design, highest design, and which entries have both bounds, each ``[D]``.

    Raises:
        ValueError: if it has neither, or the bounds are not the same in all rows of the environment.
    """
    if "design" in env.observation_spec.keys():  # noqa: SIM118
        spec = env.observation_spec["design"]
    elif (spec := getattr(env, "design_spec", None)) is None:
        raise ValueError(
            f"{type(env).__name__} has no designs, neither 'design' in its observation_spec nor a design_spec; take a "
            "MorphEnv such as HopperMorph, its dream, or one of these inside of transforms or of several workers"
        )
    low, high = (bound.reshape(-1, spec.shape[-1]) for bound in (spec.space.low, spec.space.high))
    if not ((low == low[0]).all() and (high == high[0]).all()):
        raise ValueError(f"designs have other bounds in other rows, {low.tolist()} to {high.tolist()}; make them alike")
    limits = torch.finfo(low.dtype)
    return low[0], high[0], (low[0] > limits.min) & (high[0] < limits.max)
