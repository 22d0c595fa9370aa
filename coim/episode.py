"""One episode of a body under a policy, as rows of the transition schema.

The loop writes bare tensors into rows that are there already; rewards and one TensorDict are made of all of them at the
end. TensorDict, specs and distribution objects cost about ten times the physics per step. All is done on the CPU, where
bodies are simulated: a policy that lives elsewhere acts by a copy, and the rows move once, when the episode is over.

Shapes: T steps, K runs, S observation, D design, A action.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from itertools import chain

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import ExplorationType, set_exploration_type

from coim.envs.designed_env import check_rewards
from coim.envs.fleet import Fleet
from coim.envs.morph import MorphEnv
from coim.envs.native_episode import Actor, Rows, play
from coim.envs.simulation import Simulations
from coim.models.policy import LOG_SCALE_RANGE, Policy, PolicyNetwork
from coim.randomness import drawing_from

Acts = Callable[[TensorDict], TensorDictBase]


@torch.no_grad()
def run_episode(
    env: MorphEnv,
    policy: Acts | None,
    *,
    design: Tensor | None = None,
    deterministic: bool = False,
    rng: torch.Generator | None = None,
    native: bool = False,
) -> TensorDict:
    """Reset the bodies and act for ``env.episode_steps`` steps.

    A row whose simulation breaks is stored as ``terminated`` and starts again with the same body; the other rows go on.

    Args:
        env: K bodies in lock-step, without transforms: rows hold what the bodies do, not what a transform makes of it.
        policy: who acts; None draws every action uniformly. A `Policy` that is as it was made acts without TensorDicts,
            many times faster than any other module or function of a TensorDict ``[K]`` on the CPU that reads
            ``observation`` and ``design`` and returns it with ``action``.
        design: ``[K, D]`` bodies to build before the episode; None keeps the present ones.
        deterministic: act with the mode of the policy instead of a sample.
        rng: where the actions' noise comes from; None uses torch's default generator of the CPU. Drawn on the CPU, an
            episode is the same on each device, to rounding.
        native: let a `Policy` that is as it was made act in native code, which the C++ compiler makes within a second
            when it is first asked for. Actions are the same up to rounding; one body takes a third to a seventh of the
            time, 64 two thirds. Other policies act in Python.

    Returns:
        Rows ``[T, K]`` in the transition schema, on the environment's device.

    Raises:
        TypeError: if ``env`` is no `MorphEnv`, such as a TransformedEnv.
        ValueError: if the design leaves its bounds (see `MorphEnv.reset`), or an action or a reward is not finite.
        RuntimeError: if native code is asked for and cannot be compiled.

    Example:
        >>> from coim import HopperMorph
        >>> rows = run_episode(HopperMorph(num_runs=2, episode_steps=5, seed=0), None)
        >>> rows.batch_size, rows["observation"].shape
        (torch.Size([5, 2]), torch.Size([5, 2, 11]))
    """
    if not isinstance(env, MorphEnv):
        raise TypeError(
            f"an episode steps the bodies themselves, not {type(env).__name__}: pass a MorphEnv, which of a "
            "TransformedEnv is its base_env, or take TorchRL's rollout, which applies the transforms"
        )
    start = None if design is None else TensorDict({"design": design}, env.batch_size, device=env.device)
    state = env.reset(start).to("cpu")
    observation, design = state["observation"], state["design"]
    steps, shape = env.episode_steps, env.action_spec.shape
    noise = _noise(steps, shape, policy, deterministic, rng)
    observations = observation.new_empty(steps, *observation.shape)
    following = torch.empty_like(observations)
    actions = observation.new_empty(steps, *shape)
    broken = torch.zeros(steps, *env.batch_size, 1, dtype=torch.bool, device="cpu")
    actor = None if policy is None else _on_cpu(policy)
    known = actor.network if isinstance(actor, Policy) and actor.is_unaltered() else None
    if native and known is not None and (acting := _native(env, known, design)) is not None:
        play(env, acting, None if deterministic else noise, Rows(observations, actions, following, broken))
    else:
        network = None if known is None else known.for_design(design)
        rows = zip(observations.unbind(), actions.unbind(), following.unbind(), broken.unbind())
        for t, (observed, acted, followed, ended) in enumerate(rows):
            observed.copy_(observation)
            if actor is None:
                acted.copy_(noise[t])
            elif network is None:
                acted.copy_(_called(actor, observation, design, deterministic, rng))
            else:
                loc, scale = network(observation)
                torch.tanh(loc if deterministic else torch.addcmul(loc, scale, noise[t]), out=acted)
            observation, terminated = env.move(acted)
            followed.copy_(observation)
            if terminated.any():
                ended.copy_(terminated)
                again = TensorDict({"_reset": terminated}, env.batch_size, device=env.device)
                observation = env.reset(again)["observation"].cpu()
    designs = design.expand(steps, *design.shape)
    rewards = env.reward(observations, actions, following, designs, env.task)
    check_rewards(rewards, design, name=type(env).__name__)
    truncated = torch.zeros_like(broken)
    truncated[-1] = True
    episode = TensorDict(
        {
            "observation": observations,
            "design": designs,
            "action": actions,
            "next": TensorDict(
                {
                    "observation": following,
                    "design": designs,
                    "reward": rewards,
                    "terminated": broken,
                    "truncated": truncated,
                    "done": broken | truncated,
                },
                [steps, *env.batch_size],
            ),
        },
        [steps, *env.batch_size],
    )
    return episode if env.device is None else episode.to(env.device)


def _native(env: MorphEnv, network: PolicyNetwork, design: Tensor) -> Actor | None:
    """The policies as native code reads them, or None where it cannot: bodies see or move in a way of their own."""
    if type(env.simulations) is not Simulations:
        return None
    for name in ("move", "_see"):
        if getattr(type(env), name) is not getattr(Fleet, name) or name in vars(env):
            return None
    actor = Actor(*network.constants(design), LOG_SCALE_RANGE)
    return actor if actor.fits(env) else None


def _called(
    policy: Acts, observation: Tensor, design: Tensor, deterministic: bool, rng: torch.Generator | None
) -> Tensor:
    """The action of any policy, by calling it, ``[K, A]``."""
    seen = TensorDict({"observation": observation, "design": design}, observation.shape[:1])
    kind = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    with drawing_from(rng, observation.device), set_exploration_type(kind):
        return policy(seen)["action"]


def _on_cpu(policy: Acts) -> Acts:
    """The policy, or a copy of a module that lives elsewhere, whose every action would have to be waited for."""
    if not isinstance(policy, nn.Module):
        return policy
    tensors = chain(policy.parameters(), policy.buffers())
    return policy if all(tensor.device.type == "cpu" for tensor in tensors) else deepcopy(policy).cpu()


def _noise(
    steps: int, shape: torch.Size, policy: Acts | None, deterministic: bool, rng: torch.Generator | None
) -> Tensor:
    """What randomness the whole episode needs: uniform actions, standard normal noise, or none, ``[T, K, A]``."""
    if policy is not None and deterministic:
        return torch.empty(0, device="cpu")
    draw = torch.rand if policy is None else torch.randn
    noise = draw(steps, *shape, generator=rng, dtype=torch.float32, device="cpu" if rng is None else rng.device).cpu()
    return noise * 2 - 1 if policy is None else noise
