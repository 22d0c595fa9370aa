"""One-step imagination: the rows of Replay_Art (Sec. 5).

Shapes: ``N`` states, ``K`` runs, ``S`` state, ``A`` action, ``D`` design.

References:
    Co-Imagination of Behaviour and Morphology of Agents: Eq. 7-8 and Algorithm 1 ("refresh Replay_Art").

    CSE, arXiv:2507.07348: predictions anchored at real transitions.
"""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coim.designs import DesignGenerator
from coim.envs.world_model import WorldModelEnv
from coim.objectives.runs import check_runs_last
from coim.pairs import StatesAre, impossible_pairs, stand_ins
from coim.randomness import drawing_from

# On a CPU, larger products no longer fit the cache of a core and gain nothing; elsewhere a chunk shall fit the memory.
CHUNK_ROWS = {"cpu": 3_000}
MANY_ROWS = 100_000

Actions = Literal["fresh", "replayed"]
SEEN = ("observation", "design")
REAL = (*SEEN, "action", ("next", "observation"), ("next", "terminated"))  # what an anchor consists of


@torch.no_grad()
def imagine(
    dream: WorldModelEnv,
    states: TensorDictBase,
    policy: TensorDictModuleBase,
    generator: DesignGenerator,
    *,
    states_are: StatesAre = "stored",
    anchored: bool = False,
    actions: Actions = "fresh",
    rng: torch.Generator | None = None,
) -> TensorDict:
    """Imagine one step from each state: xi_g ~ G(xi), a_g ~ pi(s, xi_g), s' = h(s, a_g, xi_g), r(s, a_g, s', xi_g).

    Args:
        dream: steps the learned model; its own batch size does not matter here.
        states: ``[N]``, or ``[N, K]`` for a fleet, with ``observation`` ``[..., S]`` and ``design`` ``[..., D]``, as
            sampled of Replay_Pop; whatever else they hold is ignored, unless it is asked for below.
        policy: any module that reads ``observation`` and ``design`` and writes ``action``; it is sampled, not asked for
            its mean.
        generator: G, the designs that the rows are imagined with.
        states_are: ``"stored"`` keeps the state of the old body under the new design, as the paper does.
            ``"matched"`` puts it under the new one by the bodies' ``transfer``: the same joints, velocities and
            clearance. A pair that cannot be even then (see `coim.pairs.impossible_pairs`) is not imagined; another
            pair of its run is imagined twice.
        anchored: start from real transitions (s, a, s'), which ``states`` then hold, and imagine what the other design
            and action change of them, s'_g = s' + h(s_g, a_g, xi_g) - h(s, a, xi), by the mean of one member. A
            broken simulation is no anchor: its row is not imagined.
        actions: ``"fresh"`` ones of the policy, or those that are ``"replayed"`` with their states.
        rng: of all that is drawn here, on the states' device; torch's global generators stay as they are. Without it G
            and the policy draw from the global generator and the dream from its own.

    Returns:
        Rows ``[N]`` or ``[N, K]`` with the schema of the buffers, without gradients; nothing is terminated. The next
        design is xi_g too: what Eq. 7 prints as V(h(s, a_g, xi_g)) is read as V(h(s, a_g, xi_g), xi_g).

    Raises:
        ValueError: if there are no states, an entry is missing, an option is unknown, no pair of a run is possible, or
            a number that is not finite comes out: of the generator, the policy, the model or the reward.
        TypeError: if states are to be matched and the dream's bodies have no ``transfer``, or rows are to be anchored
            and its model has no ``means``.

    Note:
        Stored states are often impossible under another design (a foot in the floor), and the model is then far off: on
        the Hopper under uniform designs a third to more than half of them (docs/results/README.md, "Imagined rows").

    Example:
        >>> from coim import GaussianEnsemble, HopperMorph, NoisyDesigns, make_policy
        >>> env = HopperMorph(seed=0)
        >>> dream = WorldModelEnv(GaussianEnsemble.for_env(env, num_cells=(32,)), env, batch_size=[1])
        >>> states = TensorDict({"observation": torch.zeros(51, 11), "design": torch.ones(51, 4)}, [51])
        >>> states["observation"][:, 0] = 1.25  # m: they stand
        >>> rows = imagine(dream, states, make_policy(env), NoisyDesigns(env.design_spec, sigma=0.1))
        >>> rows["next", "reward"].shape
        torch.Size([51, 1])
    """
    check_options(dream, states_are, actions)
    needed = REAL if anchored else (*SEEN, "action") if actions == "replayed" else SEEN
    missing = [key for key in needed if key not in states.keys(include_nested=True)]
    if missing or not states.batch_size.numel():
        lack = f"lack {sorted(missing, key=str)}" if missing else f"have batch size {list(states.batch_size)}"
        raise ValueError(f"the states to imagine from {lack}; sample rows of Replay_Pop")
    if states.batch_dims > 2:
        raise ValueError(f"the states to imagine from have batch size {list(states.batch_size)}; give [N], or [N, K]")
    if states.batch_dims == 2:
        check_runs_last(states, states.batch_size[-1])
    device, rows_per_state = states["observation"].device, states.batch_size[1:].numel()
    size = CHUNK_ROWS.get(device.type, MANY_ROWS)
    rows = states.select(*needed)
    with drawing_from(rng, device), set_exploration_type(ExplorationType.RANDOM):
        if states_are == "matched" or anchored:
            # All at once: a small chunk could be without a pair that can be.
            rows = _usable_pairs(dream, rows, generator, states_are, rng)
        chunks = rows.split(max(1, size // rows_per_state))
        done = [_imagine_chunk(dream, chunk, policy, generator, anchored, actions, rng) for chunk in chunks]
    return torch.cat(done)


def _usable_pairs(
    dream: WorldModelEnv,
    states: TensorDictBase,
    generator: DesignGenerator,
    states_are: StatesAre,
    rng: torch.Generator | None,
) -> TensorDictBase:
    """States with what is asked about each, ``("asked", "observation")`` and ``("asked", "design")``."""
    observation, design = states["observation"], generator(states["design"].clone(), rng=rng)
    usable = torch.ones(states.batch_size, dtype=torch.bool, device=observation.device)
    if states_are == "matched" and dream.transfer is not None and dream.clearance is not None:
        observation = dream.transfer(observation, states["design"], design)
        usable &= ~impossible_pairs(dream.clearance, observation, design)
    if "next" in states:
        usable &= ~states["next", "terminated"].squeeze(-1)
    pairs = states.copy()
    pairs["asked"] = TensorDict({"observation": observation, "design": design}, states.batch_size)
    taken = stand_ins(usable)
    return pairs[taken] if taken.ndim == 1 else pairs[taken, torch.arange(taken.shape[1], device=taken.device)]


def _imagine_chunk(
    dream: WorldModelEnv,
    states: TensorDictBase,
    policy: TensorDictModuleBase,
    generator: DesignGenerator,
    anchored: bool,
    actions: Actions,
    rng: torch.Generator | None,
) -> TensorDict:
    """Imagine so many rows at once."""
    if "asked" in states:
        observation, design = states["asked", "observation"], states["asked", "design"]
    else:
        observation, design = states["observation"], generator(states["design"].clone(), rng=rng)
    if actions == "fresh":
        asked = TensorDict({"observation": observation, "design": design}, states.batch_size, device=states.device)
        action = policy(asked)["action"]
    else:
        action = states["action"]
    if anchored:
        next_observation, reward = dream.advance_beside(states, observation, action, design, generator=rng)
    else:
        next_observation, reward = dream.advance(observation, action, design, generator=rng)
    _check_finite(observation, design, action, next_observation, reward)
    never = torch.zeros_like(reward, dtype=torch.bool)
    after = {"observation": next_observation, "design": design, "reward": reward}
    after |= {"terminated": never, "truncated": never.clone(), "done": never.clone()}
    row = {"observation": observation, "design": design, "action": action, "next": after}
    return TensorDict(row, states.batch_size, device=states.device)


def _check_finite(observation: Tensor, design: Tensor, action: Tensor, following: Tensor, reward: Tensor) -> None:
    """Refuse numbers that are not finite by the name of what gave them; a learner would find its own to be broken."""
    if following.isfinite().all() and reward.isfinite().all():
        return
    for value, reason in (
        (observation, "a state to imagine from is not finite; drop such rows of Replay_Pop"),
        (design, "the generator makes a design that is not finite; let it end with design_spec.project()"),
        (action, "the policy gives an action that is not finite; it has diverged"),
        (
            following,
            "the model of the dynamics predicts a next observation that is not finite; train it, or check its "
            "weights and the states it was given",
        ),
    ):
        if not value.isfinite().all():
            raise ValueError(reason)
    row = (~reward.isfinite()).nonzero()[0][:-1].unbind()
    raise ValueError(
        f"the reward of an imagined step is {reward[row].item()} for the body {design[row].tolist()}, although the "
        f"state that the model predicts, {following[row].tolist()}, is finite; give reward() a value for this state"
    )


def check_options(dream: WorldModelEnv, states_are: str, actions: str) -> None:
    """Refuse words that are unknown, and what the dream's bodies cannot do."""
    if states_are not in ("stored", "matched"):
        raise ValueError(f"states_are={states_are!r} is unknown; choose 'stored' or 'matched'")
    if actions not in ("fresh", "replayed"):
        raise ValueError(f"actions={actions!r} is unknown; choose 'fresh' or 'replayed'")
    if states_are == "matched" and dream.transfer is None:
        raise TypeError(
            "states are matched by the transfer() of the bodies that the dream was made of, and these have none; make "
            "the dream of a MorphEnv, or leave the states 'stored'"
        )
