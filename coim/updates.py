"""What is learnt after an episode: how many updates, from which rows, and the loop over them.

Shapes: K runs.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Algorithm 1, Sec. 5 and 6.1.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from coim.agreement import check_counts
from coim.batches import BatchParts, batch_parts, sample_mixture
from coim.buffers import Buffers
from coim.imagined_replay import ImaginedReplay
from coim.learners.dynamics import DynamicsLearner
from coim.learners.sac import SACLearner
from coim.randomness import Stream

UPDATES_PER_SAMPLE = 50  # batches drawn in one call: the replay's fixed cost is paid once for all of them

Means = dict[str, Tensor]
"""Means over the updates of an episode by their names, each ``[K]`` on the CPU."""
Name = Literal["individual", "population", "model"]
BATCHES: tuple[Stream, ...] = ("individual", "population", "model")
GOVERNED: tuple[Stream, ...] = ("imagined states", "imagined population", "imagined individual")
"""What else is drawn if a governor decides how much is imagined."""


@contextmanager
def booked(seconds: dict[str, float], part: str) -> Iterator[None]:
    """Book the wall-clock of a block to a part."""
    start = time.perf_counter()
    yield
    seconds[part] = time.perf_counter() - start


@dataclass(frozen=True, kw_only=True)
class UpdatePlan:
    """How many updates follow each episode, and the rows of their batches; the defaults are the paper's.

    Attributes:
        individual_updates: updates of the individual learner per episode.
        population_updates: updates of the population learner per episode.
        model_updates: updates of the ensemble per episode; the paper does not give them, by default as many as the
            population's.
        batch_size: rows in a batch of any of them.
        imagined_share: share of a population batch drawn from Replay_Art (Sec. 5).
        individual_mix: share of an individual batch drawn from Replay_Pop ("primarily", Sec. 4; 0 in Algorithm 1).
        individual_imagined_share: share of an individual batch drawn from Replay_Art. Algorithm 1 cites Eq. 7-8 for the
            individual networks too, Sec. 5 gives imagined rows to the population alone; 0 follows Sec. 5.

    Raises:
        ValueError: if a count is no whole number or below its least value, or a share outside [0, 1]. When `rows` are
            asked for: if a share is of less than a row, or those of a batch are more than all of it.

    Example:
        >>> plan = UpdatePlan()
        >>> plan.rows("population"), plan.imagined_rows
        (BatchParts(own=205, other=0, imagined=51), 12750)
    """

    individual_updates: int = 1000
    population_updates: int = 250
    model_updates: int = 250
    batch_size: int = 256
    imagined_share: float = 0.2
    individual_mix: float = 0.0
    individual_imagined_share: float = 0.0

    def __post_init__(self) -> None:
        names = ("individual_updates", "population_updates", "model_updates")
        check_counts({"batch_size": self.batch_size}, {name: getattr(self, name) for name in names})
        for name in ("imagined_share", "individual_mix", "individual_imagined_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}, it must lie in [0, 1]")

    def without_imagination(self) -> UpdatePlan:
        """The same plan for the model-free baseline."""
        return replace(self, imagined_share=0.0, individual_imagined_share=0.0)

    def updates(self, name: Name) -> int:
        """Updates of one learner per episode."""
        return {
            "individual": self.individual_updates,
            "population": self.population_updates,
            "model": self.model_updates,
        }[name]

    def rows(self, name: Name) -> BatchParts:
        """Rows of one learner's batch by where they come from."""
        if name == "individual":
            return batch_parts(self.batch_size, imagined=self.individual_imagined_share, other=self.individual_mix)
        return batch_parts(self.batch_size, imagined=self.imagined_share if name == "population" else 0.0)

    @property
    def imagined_rows(self) -> int:
        """Imagined rows that the updates after one episode draw in all, and at least one: the size of Replay_Art."""
        drawn = [self.updates(name) * self.rows(name).imagined for name in ("individual", "population")]
        return max(1, sum(drawn))


class Training:
    """The updates of individual, population and ensemble after each episode.

    Args:
        plan: how many updates there are, and of which rows.
        buffers: the rows.
        learners: by their names; without ``"model"`` no ensemble is trained.
        rngs: draw the rows of each learner's batches, by the same names, on the device of the buffers. Those of
            `GOVERNED` draw the imagined rows of governed batches.
        imagined: how much of a batch is imagined; None imagines nothing.
        side_by_side: train the individual learner in one thread while another trains the population's and the ensemble.
    """

    def __init__(
        self,
        plan: UpdatePlan,
        buffers: Buffers,
        learners: Mapping[Name, SACLearner | DynamicsLearner],
        rngs: Mapping[Stream, torch.Generator],
        *,
        imagined: ImaginedReplay | None = None,
        side_by_side: bool = False,
    ) -> None:
        self.plan, self.buffers, self.learners, self.rngs, self.imagined = plan, buffers, learners, rngs, imagined
        self._beside = ThreadPoolExecutor(1, "coim-population") if side_by_side else None
        self._abandoned = threading.Event()

    @property
    def updates_per_episode(self) -> int:
        """Updates of all learners together."""
        return sum(self.plan.updates(name) for name in self.learners)

    def after_episode(self, seconds: dict[str, float]) -> Means:
        """Train pi_Ind and Q_Ind, then pi_Pop and Q_Pop, then the ensemble; or the first beside the other two.

        Args:
            seconds: is told how long each took.

        Returns:
            The mean of each metric, by ``learner/metric``.

        Raises:
            RuntimeError: if an update failed in the other thread.
        """
        if self._beside is None:
            return self._train_in_turn(("individual", "population", "model"), seconds)
        beside = self._beside.submit(self._train_in_turn, ("population", "model"), seconds)
        try:
            return self._train_in_turn(("individual",), seconds) | beside.result()
        except BaseException:
            self._abandoned.set()  # a process that is told to end would wait for the other thread
            raise

    def _train_in_turn(self, names: tuple[Name, ...], seconds: dict[str, float]) -> Means:
        means: Means = {}
        for name in names:
            if name in self.learners:
                with booked(seconds, f"train {name}"):
                    found = self.train(name, self.learners[name], rng=self.rngs[name])
                means |= {f"{name}/{metric}": value for metric, value in found.items()}
        return means

    def train(self, name: Name, learner: SACLearner | DynamicsLearner, *, rng: torch.Generator) -> Means:
        """Let a learner make the updates of an episode.

        Args:
            name: of the learner whose number of updates and whose rows are taken.
            learner: that learner, or another one to be compared with it.
            rng: draws the rows.

        Returns:
            The mean of each metric over the updates.
        """
        updates, means = self.plan.updates(name), Means()
        for done in range(0, updates, UPDATES_PER_SAMPLE):
            if self._abandoned.is_set():
                raise RuntimeError("an update failed or was interrupted; go on from a state_dict of before")
            count = min(UPDATES_PER_SAMPLE, updates - done)
            for metric, value in learner.update(self._batches(name, count, rng)).items():
                means[metric] = means.get(metric, 0.0) + value.cpu() * (count / updates)
        return means

    def _batches(self, name: Name, count: int, rng: torch.Generator) -> TensorDictBase:
        """Draw so many batches for one learner, ``[count, B, K]``."""
        rows, buffers = self.plan.rows(name), self.buffers
        own = buffers.ind if name == "individual" else buffers.pop
        if name == "model" or self.imagined is None or self.imagined.governor is None:
            mixture = ((own, rows.own), (buffers.pop, rows.other), (buffers.art, rows.imagined))
            return sample_mixture(mixture, count, imagined=buffers.art, rng=rng)
        # Governed, a batch is drawn as the model-free baseline draws it, and imagined rows are put into it afterwards.
        real = ((own, rows.own + rows.imagined), (buffers.pop, rows.other))
        batches = sample_mixture(real, count, imagined=buffers.art, rng=rng)
        stream: Stream = "imagined individual" if name == "individual" else "imagined population"
        return self.imagined.put_into(batches, rows.imagined / self.plan.batch_size, rng=self.rngs[stream])
