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

from coim.batches import put_imagined, sample_batches
from coim.buffers import TransitionBuffer
from coim.designs import DesignGenerator
from coim.envs.world_model import WorldModelEnv
from coim.governor import Governor
from coim.imagination import Actions, imagine
from coim.pairs import StatesAre, impossible_pairs


class ImaginedReplay:
    """Replay_Art and how it is refreshed.

    Args:
        art: Replay_Art.
        dream: where transitions are imagined.
        generator: G.
        states_are: see :func:`coim.imagine`.
        anchored: see :func:`coim.imagine`.
        actions: see :func:`coim.imagine`.
        governor: of the share of imagined rows; None leaves it to the settings.

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

    def state_dict(self) -> dict[str, Any]:
        """Return what the coming refreshes depend on, beside the buffers and the generators."""
        return {"counts": self.counts, "governor": None if self.governor is None else self.governor.state_dict()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on as the one that :meth:`state_dict` was read from."""
        self.counts = self.counts and state_dict["counts"]
        if self.governor is not None:
            self.governor.load_state_dict(state_dict["governor"])


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
