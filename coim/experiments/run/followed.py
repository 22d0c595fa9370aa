"""The interface between a run on disk and the algorithm that it follows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Protocol, TypeVar

from coim.envs import MorphEnv
from coim.events import Event
from coim.learners.divergence import Divergence
from coim.learners.sac import SACLearner
from coim.position import Position
from coim.updates import Training


class Followed(Protocol):
    """Algorithm 1, or something that goes on as it does, such as one whose models are measured.

    `coim.experiments.train.follow` iterates it, tells its progress, and keeps its checkpoints and best policies.
    Nothing else is asked of it. `coim.CoAdaptation` is one.
    """

    @property
    def env(self) -> MorphEnv:
        """Bodies to train on."""

    @property
    def evaluation_env(self) -> MorphEnv:
        """Bodies to evaluate on."""

    @property
    def individual(self) -> SACLearner:
        """Learner whose policy is evaluated."""

    @property
    def position(self) -> Position:
        """How far it is."""

    @property
    def divergence(self) -> Divergence:
        """Which runs have diverged."""

    @property
    def training(self) -> Training:
        """The updates after each episode."""

    @property
    def updates_per_episode(self) -> int:
        """Updates of all networks after an episode, measured ones included."""

    def __iter__(self) -> Iterator[Event]:
        """Go on, event by event."""

    def state_dict(self) -> dict[str, Any]:
        """All that the coming events depend on."""

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on from that."""


FollowedT = TypeVar("FollowedT", bound=Followed)
