"""Replay_Art after each episode: what is imagined, and how much of it is learnt from.

Shapes: ``N`` rows, ``U`` updates, ``B`` batch, ``K`` runs.

References:
    Co-Imagination of Behaviour and Morphology of Agents: Algorithm 1 ("refresh Replay_Art") and Sec. 5.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from coim.agreement import check_model, check_transfer, sizes_of
from coim.batches import put_imagined, sample_batches
from coim.buffers import TransitionBuffer
from coim.designs import DesignGenerator
from coim.envs.morph import MorphEnv
from coim.envs.world_model import AnchoredDynamics, WorldModelEnv
from coim.governor import Governor
from coim.imagination import Actions, check_options, imagine
from coim.learners.dynamics import DynamicsLearner
from coim.models.ensemble import GaussianEnsemble
from coim.pairs import StatesAre, impossible_pairs
from coim.randomness import GLOBAL_GENERATORS

TRIES = 16  # draws of G from each design that is tried


class ImaginedReplay:
    """Replay_Art and how it is refreshed.

    Args:
        art: Replay_Art.
        dream: where transitions are imagined.
        generator: G, the designs that are imagined.
        states_are: see :func:`coim.imagine`.
        anchored: see :func:`coim.imagine`.
        actions: see :func:`coim.imagine`.
        governor: decides how much of a batch is imagined, run by run, from what is measured of the model. The planned
            share is then the most, and a run that never earns any is the model-free baseline, to the last bit. None
            imagines the planned share.

    Raises:
        TypeError: if the dream is no `WorldModelEnv`, G cannot be called, states are to be matched and the dream's
            bodies have no ``transfer``, or rows are to be anchored and its model has no ``means``.
        ValueError: if ``states_are`` or ``actions`` is unknown, or the bodies' lengths are not known as functions of
            their designs and states are to be matched.

    Example:
        >>> from coim import HopperMorph, RandomDesigns, make_policy, transition_rows
        >>> env = HopperMorph(seed=0)
        >>> pop, art = (TransitionBuffer(100, num_runs=1, seed=0) for _ in range(2))
        >>> _ = pop.extend(transition_rows(env.rollout(20)).transpose(0, 1))
        >>> dream = WorldModelEnv(GaussianEnsemble.for_env(env, num_cells=(8,)), env, batch_size=env.batch_size)
        >>> imagined = ImaginedReplay(art, dream, RandomDesigns(env.design_spec), states_are="matched")
        >>> imagined.refresh(pop, make_policy(env), 50, rng=torch.Generator())
        {'impossible': tensor([0.])}
        >>> len(art)
        50

    Attributes:
        counts: whether impossible pairs are counted. Not where the bodies cannot tell how high they stand (see
            `coim.envs.kinematics`), and not in a run that was begun before they were, whose tables have no column.
    """

    def __init__(
        self,
        art: TransitionBuffer,
        dream: WorldModelEnv,
        generator: DesignGenerator,
        *,
        states_are: StatesAre = "stored",
        anchored: bool = False,
        actions: Actions = "fresh",
        governor: Governor | None = None,
    ) -> None:
        if not isinstance(dream, WorldModelEnv):
            raise TypeError(
                f"the dream is a {type(dream).__name__}, and imagination asks its model itself; pass a WorldModelEnv, "
                "which of a TransformedEnv is its base_env"
            )
        if not callable(generator):
            raise TypeError(
                f"the generator is a {type(generator).__name__}; pass a DesignGenerator, such as NoisyDesigns"
            )
        check_options(dream, states_are, actions)
        if anchored and not isinstance(dream.ensemble, AnchoredDynamics):
            raise TypeError(
                f"a {type(dream.ensemble).__name__} has no means() to anchor with; give it one as AnchoredDynamics has "
                "it, or leave anchored out"
            )
        self.art, self.dream, self.generator = art, dream, generator
        self.states_are, self.anchored, self.actions = states_are, anchored, actions
        self.governor = governor
        self.counts = _clearance_is_known(dream)

    def refresh(
        self,
        pop: TransitionBuffer,
        policy: TensorDictModuleBase,
        num_rows: int,
        *,
        rng: torch.Generator,
        states_rng: torch.Generator | None = None,
    ) -> dict[str, Tensor]:
        """Empty Replay_Art and fill it with states of Replay_Pop, designs of G, and actions of the policy.

        Args:
            pop: Replay_Pop; while it is empty, nothing is imagined.
            policy: pi_Pop.
            num_rows: N.
            rng: of all that is drawn, where the dream is.
            states_rng: of the states to imagine from, where Replay_Pop is; read if there is a governor. Without one
                they are drawn with Replay_Pop's own generator.

        Returns:
            ``impossible``, the share of imagined pairs that no body can be in (see `coim.pairs.impossible_pairs`),
            ``[K]`` on the CPU, 0 where nothing is imagined; no such entry if it is not counted.
        """
        self.art.empty()
        if len(pop) == 0 or (self.governor is not None and not self.governor.earns()):
            nothing = torch.zeros(self.art.num_runs, dtype=torch.float32, device="cpu")
            return {"impossible": nothing} if self.counts else {}
        if self.governor is None:
            states = pop.sample(num_rows)
        else:  # a run whose share is nothing finds Replay_Pop's generator where the model-free baseline leaves it
            states = sample_batches(pop, batch_size=num_rows, rng=states_rng)[0]
        states = states.to(self.dream.device or "cpu")
        rows = imagine(
            self.dream,
            states,
            policy,
            self.generator,
            states_are=self.states_are,
            anchored=self.anchored,
            actions=self.actions,
            rng=rng,
        )
        if self.governor is not None:
            rows = self.governor.agreeing(rows, states)
        self.art.extend(rows)
        if not self.counts or self.dream.clearance is None:
            return {}
        impossible = impossible_pairs(self.dream.clearance, rows["observation"], rows["design"])
        return {"impossible": impossible.float().mean(0).cpu()}

    def put_into(self, batches: TensorDictBase, most: float, *, rng: torch.Generator) -> TensorDictBase:
        """Let each run learn from as many imagined rows as it has earned.

        Args:
            batches: ``[U, B, K]``, all of them real.
            most: share of a batch that may be imagined.
            rng: draws the rows.

        Returns:
            Batches of the same shape; without a governor, or where nothing is earned, the same ones.
        """
        if self.governor is None or len(self.art) == 0:
            return batches
        num_rows = (self.governor.shares(most) * batches.shape[1]).round().long()
        return put_imagined(batches, self.art, num_rows, rng=rng)

    def check_fits(
        self, env: MorphEnv, art: TransitionBuffer, dynamics: DynamicsLearner | None, first_designs: Tensor
    ) -> None:
        """Refuse to imagine for other bodies, into another buffer, or by a model of which nothing is learnt.

        Args:
            env: the bodies.
            art: Replay_Art, from which learners draw.
            dynamics: learner of the model, or None.
            first_designs: ``[I, D]`` or ``[I, K, D]``, on which G is tried.

        Raises:
            ValueError: if the dream steps another ensemble than the one that learns or one that has learnt nothing, is
                of other bodies or pays other rewards, the bodies cannot tell how high they stand and states are to be
                matched, nothing is learnt that could be governed, or G leaves the bounds.
        """
        if art is not self.art:
            raise ValueError("imagined rows go into another buffer than buffers.art; make both with the same one")
        if self.governor is not None and (dynamics is None or self.governor.ensemble is not dynamics.ensemble):
            raise ValueError(
                "what is imagined is governed by the errors of the model that is learnt; give dynamics, and its "
                "ensemble to the governor"
            )
        model = self.dream.ensemble
        if isinstance(model, GaussianEnsemble):
            if dynamics is not None and model is not dynamics.ensemble:
                raise ValueError(
                    "the dream steps another ensemble than the one that dynamics trains; make it with dynamics.ensemble"
                )
            if dynamics is None and not model.inputs.count.any():
                raise ValueError(
                    "the dream steps an ensemble that has seen nothing and that nobody trains; give its learner as "
                    "dynamics"
                )
        _check_rewards(env, self.dream)
        check_model(env, model)
        if self.states_are == "matched":
            check_transfer(env)
        _check_generator(env, self.generator, first_designs)

    def state_dict(self) -> dict[str, Any]:
        """Return what the coming refreshes depend on, beside the buffers and the generators."""
        return {"counts": self.counts, "governor": None if self.governor is None else self.governor.state_dict()}

    def load_state_dict(self, state_dict: Mapping[str, Any] | None) -> None:
        """Go on as the one that :meth:`state_dict` was read from.

        Args:
            state_dict: None of a run that was begun before impossible pairs were counted. It goes on with the columns
                that its tables have.

        Raises:
            ValueError: if only one of the two is governed.
        """
        state = state_dict or {"counts": False, "governor": None}
        if (state["governor"] is None) != (self.governor is None):
            raise ValueError("one of the state and the algorithm is governed and the other is not; make it alike")
        self.counts = self.counts and state["counts"]
        if self.governor is not None:
            self.governor.load_state_dict(state["governor"])


def _clearance_is_known(dream: WorldModelEnv) -> bool:
    """Whether the bodies of a dream can tell how high they stand; not all can, and nothing else needs it."""
    if dream.clearance is None:
        return False
    observation, design = (dream.full_observation_spec_unbatched[key].zero() for key in ("observation", "design"))
    try:
        dream.clearance(observation, design.fill_(1.0))
    except ValueError:
        return False
    return True


def _check_rewards(env: MorphEnv, dream: WorldModelEnv) -> None:
    """Compare the rewards of dream and bodies on a few rows that stand for all."""
    sizes = sizes_of(env), sizes_of(dream)
    if sizes[0] != sizes[1]:
        raise ValueError(f"the dream has sizes {sizes[1]}, the bodies {sizes[0]}; make the dream of these bodies")
    rng = torch.Generator("cpu").manual_seed(0)
    observation, action, following, design = (
        torch.randn(TRIES, sizes[0][key], generator=rng, dtype=torch.float32, device="cpu").to(env.device or "cpu")
        for key in ("observation", "action", "observation", "design")
    )
    row = (observation, action.tanh(), following, design.sigmoid() + 0.5)
    if not torch.allclose(dream.reward_fn(*row), env.reward_fn(*row), equal_nan=True):  # of made-up states
        raise ValueError(
            "the dream pays other rewards than the bodies: it was made of another body or task; make it of this env"
        )


def _check_generator(env: MorphEnv, generator: DesignGenerator, first_designs: Tensor) -> None:
    """Try G on the first designs and on two corners; torch's global generators stay as they are."""
    low, high = env.design_spec.space.low, env.design_spec.space.high
    tried = torch.cat([first_designs.flatten(0, -2), low[None], high[None]]).repeat(TRIES, 1)
    tried = tried.unsqueeze(1).expand(-1, env.batch_size.numel(), -1)  # [N, K, D]
    with GLOBAL_GENERATORS, torch.random.fork_rng(devices=[tried.device] if tried.device.type == "cuda" else []):
        found = generator(tried.clone(), rng=torch.Generator(tried.device).manual_seed(0))
    if found.shape != tried.shape:
        raise ValueError(
            f"the generator makes designs {list(found.shape)} of designs {list(tried.shape)}; it must keep their shape"
        )
    if found.dtype != tried.dtype or found.device != tried.device:
        raise ValueError(
            f"the generator makes designs in {found.dtype} on {found.device}, of designs in {tried.dtype} on "
            f"{tried.device}; it must keep both"
        )
    outside = ~((low <= found) & (found <= high)).all(-1)  # NaN is neither
    if outside.any():
        raise ValueError(
            f"the generator makes {found[outside][0].tolist()} of {tried[outside][0].tolist()}, which leaves "
            f"[{low.tolist()}, {high.tolist()}]; let it end with design_spec.project()"
        )
