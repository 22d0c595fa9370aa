"""One-step imagination: the rows of Replay_Art (Sec. 5).

Shapes: ``N`` states, ``K`` runs, ``S`` state, ``A`` action, ``D`` design.

References:
    Co-Imagination of Behaviour and Morphology of Agents: Eq. 7-8 and Algorithm 1 ("refresh Replay_Art").
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coim.designs import DesignGenerator
from coim.envs.world_model import WorldModelEnv
from coim.randomness import drawing_from

# On a CPU, larger products no longer fit the cache of a core and gain nothing; elsewhere a chunk shall fit the memory.
CHUNK_ROWS = {"cpu": 3_000}
MANY_ROWS = 100_000


@torch.no_grad()
def imagine(
    dream: WorldModelEnv,
    states: TensorDictBase,
    policy: TensorDictModuleBase,
    generator: DesignGenerator,
    *,
    rng: torch.Generator | None = None,
) -> TensorDict:
    """Imagine one step from each state: xi_g ~ G(xi), a_g ~ pi(s, xi_g), s' = h(s, a_g, xi_g), r(s, a_g, s', xi_g).

    Args:
        dream: steps the learned model; its own batch size does not matter here.
        states: ``[N]``, or ``[N, K]`` for a fleet, with ``observation`` ``[..., S]`` and ``design`` ``[..., D]``, as
            sampled of Replay_Pop; whatever else they hold is ignored.
        policy: any module that reads ``observation`` and ``design`` and writes ``action``; it is sampled, not asked for
            its mean.
        generator: G, the designs that the rows are imagined with.
        rng: of all that is drawn here, on the states' device; torch's global generators stay as they are. Without it G
            and the policy draw from the global generator and the dream from its own.

    Returns:
        Rows ``[N]`` or ``[N, K]`` with the schema of the buffers, without gradients; nothing is terminated. The next
        design is xi_g too: what Eq. 7 prints as V(h(s, a_g, xi_g)) is read as V(h(s, a_g, xi_g), xi_g).

    Raises:
        ValueError: if there are no states, an entry is missing, or the model predicts a number that is not finite.

    Note:
        Where G changes the design, the state stays that of the old body, as in the paper. Such pairs can be impossible
        (a foot in the floor), and the model is then far off.

    Example:
        >>> from coim import GaussianEnsemble, HopperMorph, NoisyDesigns, make_policy
        >>> env = HopperMorph(seed=0)
        >>> dream = WorldModelEnv(GaussianEnsemble.for_env(env, num_cells=(32,)), env, batch_size=[1])
        >>> states = TensorDict({"observation": torch.zeros(51, 11), "design": torch.ones(51, 4)}, [51])
        >>> rows = imagine(dream, states, make_policy(env), NoisyDesigns(env.design_spec, sigma=0.1))
        >>> rows["next", "reward"].shape
        torch.Size([51, 1])
    """
    missing = {"observation", "design"} - set(states.keys())
    if missing or not states.batch_size.numel():
        lack = f"lack {sorted(missing)}" if missing else f"have batch size {list(states.batch_size)}"
        raise ValueError(f"the states to imagine from {lack}; sample rows of Replay_Pop")
    device, rows_per_state = states["observation"].device, states.batch_size[1:].numel()
    size = CHUNK_ROWS.get(device.type, MANY_ROWS)
    chunks = states.select("observation", "design").split(max(1, size // rows_per_state))
    with drawing_from(rng, device), set_exploration_type(ExplorationType.RANDOM):
        return torch.cat([_imagine_chunk(dream, chunk, policy, generator, rng) for chunk in chunks])


def _imagine_chunk(
    dream: WorldModelEnv,
    states: TensorDictBase,
    policy: TensorDictModuleBase,
    generator: DesignGenerator,
    rng: torch.Generator | None,
) -> TensorDict:
    """Imagine so many rows at once."""
    observation = states["observation"]
    design = generator(states["design"], rng=rng)
    asked = TensorDict({"observation": observation, "design": design}, states.batch_size, device=states.device)
    action = policy(asked)["action"]
    next_observation, reward = dream.advance(observation, action, design, generator=rng)
    if not next_observation.isfinite().all():
        raise ValueError(
            "the model of the dynamics predicts a next observation that is not finite; train it, or check its weights "
            "and the states it was given"
        )
    never = torch.zeros_like(reward, dtype=torch.bool)
    after = {"observation": next_observation, "design": design, "reward": reward}
    after |= {"terminated": never, "truncated": never.clone(), "done": never.clone()}
    row = {"observation": observation, "design": design, "action": action, "next": after}
    return TensorDict(row, states.batch_size, device=states.device)
