"""Measure a model of each kind while Algorithm 1 runs.

Shapes: K runs, N rows.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Sec. 6.5 and Fig. 4(a).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from coim.coadaptation import CoAdaptation
from coim.designs import DesignGenerator, NoisyDesigns, RandomDesigns
from coim.envs import MorphEnv
from coim.events import DesignChosen, EpisodeDone, Event
from coim.experiments.model_error.errors import change_variance, mean_squares, persistence_error, prediction_error
from coim.experiments.model_error.tables import ERRORS
from coim.experiments.model_error.test_rows import Probes, joined
from coim.experiments.run.results import Table
from coim.learners.divergence import Divergence
from coim.learners.dynamics import DynamicsLearner
from coim.learners.sac import SACLearner
from coim.position import Position
from coim.randomness import restore_generator
from coim.updates import Training


class ProbedCoAdaptation:
    """Follow an algorithm, which goes on exactly as it would alone, and measure two models after its episodes.

    One model is the algorithm's own. The other one predicts the change of the observation where the first one predicts
    the next observation, or the other way round. Nothing else differs: the first weights are the same, and after each
    episode the batches of Replay_Pop.

    Rows that they are measured on, ``num_rows`` of each kind (``seen``: of each design):

    =============  ===========================================================================================
    seen           an episode of every design so far, taken at its last measurement and kept out of the replay
    next           an episode of the next design by pi_Pop, before anything was learnt on it
    never built    episodes of eight uniform designs, by the current pi_Pop
    noisy, random  states of ``seen`` with another design in place of their own, N(xi, sigma^2) or uniform
    ... possible   those of them in which no part of the new body is in the floor
    =============  ===========================================================================================

    Args:
        algorithm: one whose model imagines.
        other: the second learner, made by `other_learner`.
        probes: collects the rows that models are measured on.
        folder: the run folder; `ERRORS` grows in it.
        every: episodes of a design between two measurements; its last episode is always followed by one.
        sigma: standard deviation of the noisy designs.
        seed: seeds all that is drawn for the measurements.

    Note:
        It is `Followed` as the algorithm itself is.
    """

    def __init__(
        self,
        algorithm: CoAdaptation,
        other: DynamicsLearner,
        probes: Probes,
        folder: Path,
        *,
        every: int,
        sigma: float,
        seed: int,
    ) -> None:
        self.algorithm, self.other, self.probes = algorithm, other, probes
        self.every, self.seed, self.path = every, seed, folder / ERRORS.file
        spec = algorithm.env.design_spec
        self.swaps: dict[str, DesignGenerator] = {
            "noisy": NoisyDesigns(spec, sigma=sigma),
            "random": RandomDesigns(spec),
        }
        self.seen: list[TensorDict] = []  # [R, K] of each design
        # The other model draws its batches as the algorithm's own does; from the same state on they are the same.
        self._rng = torch.Generator(algorithm.rngs["model"].device)
        self._rng.set_state(algorithm.rngs["model"].get_state())
        self._table: Table | None = None

    @property
    def env(self) -> MorphEnv:
        """The algorithm's bodies to train on."""
        return self.algorithm.env

    @property
    def evaluation_env(self) -> MorphEnv:
        """The algorithm's bodies to evaluate on."""
        return self.algorithm.evaluation_env

    @property
    def individual(self) -> SACLearner:
        """The algorithm's individual learner."""
        return self.algorithm.individual

    @property
    def position(self) -> Position:
        """How far the algorithm is."""
        return self.algorithm.position

    @property
    def divergence(self) -> Divergence:
        """Which runs of the algorithm have diverged."""
        return self.algorithm.divergence

    @property
    def training(self) -> Training:
        """The algorithm's own updates."""
        return self.algorithm.training

    @property
    def learners(self) -> dict[str, DynamicsLearner]:
        """Both learners, by what they predict."""
        return {learner.ensemble.predict: learner for learner in (own_learner(self.algorithm), self.other)}

    @property
    def updates_per_episode(self) -> int:
        """Updates of the algorithm's learners and of the other model."""
        return self.algorithm.updates_per_episode + self.training.plan.model_updates

    def __iter__(self) -> Iterator[Event]:
        self._begun_table()
        for event in self.algorithm:
            if isinstance(event, DesignChosen) and event.index > 0:
                rows = self.probes.trajectory(self.algorithm.population.policy, event.design, seed=self._seed())
                self._write(event, "next", rows)
            elif isinstance(event, EpisodeDone):
                self._learn()
                last = self.algorithm.episodes_of(event.index)
                if (event.episode + 1) % self.every == 0 or event.episode + 1 == last:
                    self._measure(event)
            yield event

    def state_dict(self) -> dict[str, Any]:
        """Return the algorithm's state and all that the coming measurements depend on."""
        probed = {
            "other": self.other.state_dict(),
            "rng": self._rng.get_state(),
            "seen": [rows.flatten_keys(".").to_dict() for rows in self.seen],
            "csv_rows": self._table.num_rows if self._table else 0,
            "asked": self._asked(),
        }
        return {**self.algorithm.state_dict(), "probed": probed}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on as the one that :meth:`state_dict` was read from; later rows of the CSV file are dropped.

        Raises:
            ValueError: if the state is of a run that was not probed, or measured otherwise.
        """
        if "probed" not in state_dict:
            raise ValueError(f"nothing was measured in the run of {self.path.parent}; measure a new run")
        probed = state_dict["probed"]
        if probed["asked"] != self._asked():
            raise ValueError(f"the run was measured with {probed['asked']}, not with {self._asked()}; leave them")
        self.algorithm.load_state_dict(state_dict)
        self.other.load_state_dict(probed["other"])
        restore_generator(self._rng, probed["rng"])
        runs = self.algorithm.env.numel()
        # Beside those that will be seen, wherever the run was before.
        saved = [TensorDict(rows, [len(rows["design"]), runs]).unflatten_keys(".") for rows in probed["seen"]]
        self.seen = [rows.to(self.algorithm.device) for rows in saved]
        self._table = Table(self.path, ERRORS.header(), keep=probed["csv_rows"])

    def _begun_table(self) -> Table:
        """The CSV file, with its header."""
        if self._table is None:
            self._table = Table(self.path, ERRORS.header())
        return self._table

    def _asked(self) -> dict[str, int]:
        return {"every": self.every, "rows": self.probes.num_rows}

    def _seed(self) -> int:
        """A new seed for each measurement; nothing has to be saved for it."""
        return int(np.random.SeedSequence([self.seed, self.position.env_steps]).generate_state(1)[0] // 2)

    def _learn(self) -> None:
        """Let the other model learn what the algorithm's own has just learnt."""
        pop = self.algorithm.buffers.pop
        self.other.observe(pop[len(pop) - self.env.episode_steps :])
        self.training.train("model", self.other, rng=self._rng)

    def _measure(self, event: EpisodeDone) -> None:
        """Measure both models after an episode."""
        seed, policies = self._seed(), self.algorithm
        del self.seen[event.index :]
        self.seen.append(self.probes.trajectory(policies.individual.policy, event.design, seed=seed))
        seen = joined(self.seen)
        self._write(event, "seen", seen)
        strangers = self.probes.unseen_trajectories(policies.population.policy, seed=seed)
        self._write(event, "never built", strangers)
        for name, generator in self.swaps.items():
            rows, impossible = self.probes.swapped(seen, generator, seed=seed)
            share = impossible.float().mean(0)
            self._write(event, name, rows, impossible_share=share)
            rows["next", "terminated"] |= impossible.unsqueeze(-1)
            self._write(event, f"{name} possible", rows)

    def _write(
        self,
        event: DesignChosen | EpisodeDone,
        probe: str,
        rows: TensorDictBase,
        *,
        impossible_share: torch.Tensor | None = None,
    ) -> None:
        """Write a row for each run that still learns and each model; the last model predicts that nothing changes."""
        variance = change_variance(self.learners["delta"])
        valid = ~rows["next", "terminated"][..., 0]
        errors = {predict: prediction_error(one.ensemble, rows) for predict, one in self.learners.items()}
        errors["nothing"] = persistence_error(self.other.ensemble, rows)
        episode = event.episode + 1 if isinstance(event, EpisodeDone) else 0
        counts, at = valid.sum(0).tolist(), (event.index + 1, episode, self.position.env_steps, probe)
        shares = [None] * len(counts) if impossible_share is None else impossible_share.tolist()
        table = self._begun_table()
        table.append(
            dict(zip(table.columns, [run, *at, predict, *square, count, share]))
            for predict, error in errors.items()
            for run, (square, count, share) in enumerate(
                zip(zip(*(x.tolist() for x in mean_squares(error, variance, valid))), counts, shares)
            )
            if run not in event.diverged  # its own model is frozen, and the other one is not
        )


def own_learner(algorithm: CoAdaptation) -> DynamicsLearner:
    """The learner of the algorithm's own model.

    Raises:
        ValueError: if the algorithm learns no model.
    """
    if algorithm.dynamics is None:
        raise ValueError("this run learns no model to measure; let an ensemble imagine, as with --imagine known")
    return algorithm.dynamics


def other_learner(algorithm: CoAdaptation, **settings: Any) -> DynamicsLearner:
    """A learner like the algorithm's own that predicts the other thing, with the same first weights.

    Args:
        algorithm: one that has learnt nothing yet.
        settings: keywords of the `DynamicsLearner`.

    Raises:
        ValueError: if the algorithm learns no model.
    """
    twin = deepcopy(own_learner(algorithm).ensemble)
    twin.predict = "next" if twin.predict == "delta" else "delta"
    return DynamicsLearner(twin, num_runs=twin.num_runs, **settings)
