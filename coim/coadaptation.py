"""Algorithm 1: behaviour, design and dynamics learnt together, one body after the other.

`CoAdaptation` is an iterator over events. Its first loop, behaviour and networks, is here, the second one, design, in
`coim.design_choice`. It draws nothing, logs nothing and stops when nobody asks for the next event; networks, bodies,
buffers and searches are passed in.

Shapes: U updates, B batch, T steps, K runs, I first designs, D design, S observation.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Algorithm 1, Sec. 5 and 6.1.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from coim.agreement import (
    check_bodies,
    check_buffers,
    check_counts,
    check_dream,
    check_first_designs,
    check_imagined,
    check_kinds,
    check_learners,
    check_networks,
    check_precision,
    check_search,
    check_words,
)
from coim.batches import BatchParts, batch_parts, sample_mixture
from coim.buffers import Buffers
from coim.continuation import restore, state_of
from coim.design_choice import Trial, next_trial
from coim.designs import DesignGenerator, DesignSearch
from coim.envs.morph import MorphEnv
from coim.envs.world_model import WorldModelEnv
from coim.episode import run_episode
from coim.events import DesignChosen, DesignDone, EpisodeDone, Event, Kind
from coim.governor import Governor
from coim.imagination import Actions
from coim.imagined_replay import ImaginedReplay
from coim.learners.divergence import Divergence
from coim.learners.dynamics import DynamicsLearner
from coim.learners.sac import SACLearner
from coim.pairs import StatesAre

UPDATES_PER_SAMPLE = 50  # batches drawn in one call: the replay's fixed cost is paid once for all of them


Means = dict[str, Tensor]


@contextmanager
def booked(seconds: dict[str, float], part: str) -> Iterator[None]:
    """Book the wall-clock of a block to a part."""
    start = time.perf_counter()
    yield
    seconds[part] = time.perf_counter() - start


class CoAdaptation:
    """Algorithm 1 as an iterator over events; the model-free baseline is the same without ``dream`` and ``generator``.

    Args:
        env: bodies to train on, K runs in lock-step.
        evaluation_env: bodies of its own for the evaluation episodes, so that evaluating changes nothing in training.
        population: learner that sees all designs.
        individual: learner that sees the current design; starts each design from the population's weights.
        buffers: Replay_Pop, Replay_Ind, Replay_s0 and Replay_Art. They may live on the CPU while the learners are on a
            GPU, which then moves the batches of one call at once.
        search: maximises Eq. 5 over the design space.
        first_designs: ``[I, D]`` bodies that every run tries first, on the device of the bodies.
        bodies: which come after them: ``"search"`` is Algorithm 1 (the optimum of Eq. 5 and a random one in turn),
            ``"random"`` never searches. ``"fixed"`` takes the first of the first designs every time, from the start on:
            the same budget for one body.
        dynamics: learns p~ from Replay_Pop after each episode; None learns none.
        dream: where transitions are imagined; given together with ``generator``.
        generator: G, the designs that are imagined.
        num_designs: M, first designs included.
        first_episodes: episodes on each of the first designs.
        episodes: episodes on every later design.
        individual_updates: updates of the individual learner per episode.
        population_updates: updates of the population learner per episode.
        model_updates: updates of the ensemble per episode; the paper does not give them, by default as many as the
            population's.
        batch_size: rows in a batch of any of them.
        imagined_share: share of a population batch drawn from Replay_Art (Sec. 5).
        individual_mix: share of an individual batch drawn from Replay_Pop ("primarily", Sec. 4; 0 in Algorithm 1).
        individual_imagined_share: share of an individual batch drawn from Replay_Art. Algorithm 1 cites Eq. 7-8 for the
            individual networks too, Sec. 5 gives imagined rows to the population alone; 0 follows Sec. 5.
        imagined_states: what the states of imagined rows are under another design: ``"stored"`` (the paper's) or
            ``"matched"``, see `coim.imagine`.
        imagined_actions: ``"fresh"`` ones of pi_Pop (the paper's), or those ``"replayed"`` with the states.
        anchored: whether imagined rows start from real transitions, see `coim.imagine`.
        governed: whether ``imagined_share`` is the most of a batch that may be imagined, and how much is depends on
            what is measured of the model, run by run (see `coim.governor`). A run that never earns any is the
            model-free baseline, to the last bit.
        num_start_states: n, start states that Eq. 5 averages over.
        value_states: what the states of Eq. 5 are under the query: ``"stored"`` (the paper's) or ``"matched"``, see
            `coim.DesignValue`.
        value_over: states that Eq. 5 averages over: those that episodes ``"start"`` with (the paper's), or those that
            were ``"visited"`` so far, a draw of Replay_Pop.
        side_by_side: train the individual learner in one thread while another trains the population's and the ensemble.
            They do not depend on each other, and the result is the same to the last bit. For learners on the CPU.
        precision: of the networks' products in Eq. 5; each learner has its own.
        seed: seeds the generators of the actions, the imagination and the random designs. Actions and random designs
            are drawn on the CPU wherever the networks are: there the same seed gives the same first episode.

    Raises:
        ValueError: if a count is no whole number or below its least value, a share outside [0, 1] or of less than a
            row, a word such as ``bodies`` is unknown, nothing is learnt that could be governed, or the parts do not
            agree (see `coim.agreement`): two environments or learners are one, evaluation is of another body or task,
            networks lack the runs of the bodies or have other sizes, the two learners' networks or their scalings
            differ, buffers are too small or for other runs, the dream steps another ensemble than the one that learns
            or pays other rewards, G or the search leaves the bounds, first designs have the wrong shape, dtype or
            device, or learners that are not on the CPU shall go side by side.
        TypeError: if an environment or the dream is behind transforms, or a part is no such thing at all.
        RuntimeError: if networks were moved after their learner was made.

    Note:
        Whoever stops at an event may come back to it: iterating again goes on with what comes next, and so does another
        instance, made alike, that loads the `state_dict`. After an exception within the loop only the latter is sound.

        Evaluation episodes leave no trace in the replay. The predecessor's code also skips training in the first three
        episodes of a design and population training in the first designs; the paper has no such rule.
    """

    def __init__(
        self,
        env: MorphEnv,
        evaluation_env: MorphEnv,
        *,
        population: SACLearner,
        individual: SACLearner,
        buffers: Buffers,
        search: DesignSearch,
        first_designs: Tensor,
        bodies: Literal["search", "random", "fixed"] = "search",
        dynamics: DynamicsLearner | None = None,
        dream: WorldModelEnv | None = None,
        generator: DesignGenerator | None = None,
        num_designs: int = 55,
        first_episodes: int = 300,
        episodes: int = 100,
        individual_updates: int = 1000,
        population_updates: int = 250,
        model_updates: int = 250,
        batch_size: int = 256,
        imagined_share: float = 0.2,
        individual_mix: float = 0.0,
        individual_imagined_share: float = 0.0,
        imagined_states: StatesAre = "stored",
        imagined_actions: Actions = "fresh",
        anchored: bool = False,
        governed: bool = False,
        num_start_states: int = 36,
        value_states: StatesAre = "stored",
        value_over: Literal["start", "visited"] = "start",
        side_by_side: bool = False,
        precision: Literal["float32", "bfloat16"] = "float32",
        seed: int = 0,
    ) -> None:
        check_words(
            bodies=(bodies, ("search", "random", "fixed")),
            imagined_states=(imagined_states, ("stored", "matched")),
            imagined_actions=(imagined_actions, ("fresh", "replayed")),
            value_states=(value_states, ("stored", "matched")),
            value_over=(value_over, ("start", "visited")),
        )
        counts = {
            "num_designs": num_designs,
            "first_episodes": first_episodes,
            "episodes": episodes,
            "batch_size": batch_size,
            "num_start_states": num_start_states,
        }
        updates = {"individual": individual_updates, "population": population_updates, "model": model_updates}
        check_counts(counts, {f"{name}_updates": count for name, count in updates.items()})
        check_precision(precision)
        check_bodies(env, evaluation_env)
        kinds: dict[str, tuple[object, type]] = {
            "population": (population, SACLearner),
            "individual": (individual, SACLearner),
            "buffers": (buffers, Buffers),
            "first_designs": (first_designs, Tensor),
        }
        check_kinds(kinds if dynamics is None else kinds | {"dynamics": (dynamics, DynamicsLearner)})
        check_first_designs(env, first_designs)
        if bodies == "search" or search is not None:
            check_search(env, search)
        self.device = check_learners(env, population, individual, dynamics, side_by_side=side_by_side)
        check_networks(env, population, individual, dynamics)
        check_dream(env, dynamics, dream, generator, first_designs)
        check_imagined(env, dream, imagined_states=imagined_states, value_states=value_states, anchored=anchored)
        self.env, self.evaluation_env = env, evaluation_env
        self.population, self.individual, self.dynamics = population, individual, dynamics
        self.divergence = Divergence(
            env.batch_size.numel(), [learner for learner in (population, individual, dynamics) if learner is not None]
        )
        self.buffers, self.search, self.first_designs, self.bodies = buffers, search, first_designs, bodies
        self.dream, self.generator = dream, generator
        self.governor = _governor(dynamics, dream) if governed else None
        self.imagined = None
        if dream is not None and generator is not None:
            self.imagined = ImaginedReplay(
                buffers.art,
                dream,
                generator,
                states_are=imagined_states,
                anchored=anchored,
                actions=imagined_actions,
                governor=self.governor,
            )
        self.value_states, self.value_over = value_states, value_over
        self.num_designs, self.first_episodes, self.episodes = num_designs, first_episodes, episodes
        self.individual_updates, self.population_updates, self.model_updates = updates.values()
        imagines = generator is not None
        self.population_parts = batch_parts(batch_size, imagined=imagined_share * imagines)
        self.individual_parts = batch_parts(
            batch_size, imagined=individual_imagined_share * imagines, other=individual_mix
        )
        self.batch_size, self.num_start_states = batch_size, num_start_states
        self.imagined_rows = self._rows_to_draw()
        check_buffers(env, buffers, imagined_rows=self.imagined_rows if imagines else 1)
        self.index, self.env_steps = 0, 0
        self.trial: Trial | None = None  # the body that is being tried
        self.rngs = self._generators(seed)
        self.precision = precision
        self._beside = ThreadPoolExecutor(1, "coim-population") if side_by_side else None
        self._abandoned = threading.Event()

    def __iter__(self) -> Iterator[Event]:
        # All that is known of the loop changes before an event: who stops there, here or in another process with this
        # one's state_dict, and comes back goes on with what would have come next.
        diverged = self.divergence.places
        while self.index < self.num_designs and (self.trial is not None or not self.divergence.everywhere):
            if self.trial is None:
                trial = self.trial = next_trial(self)
                yield DesignChosen(self.index, trial.kind, trial.design, trial.predicted, dict(diverged))
            trial = self.trial
            if trial.next_episode == 0:
                # Without the population's weights the individual networks would start from the last body's gait.
                self.individual.start_from(self.population)
                self.buffers.ind.empty()
                self._refresh_imagined()
            while trial.next_episode < self._episodes_of(self.index) and not self.divergence.everywhere:
                event = self._run_and_learn(trial.kind, trial.design, trial.next_episode)
                trial.best = torch.fmax(trial.best, event.evaluation_return.cpu())  # NaN of who has diverged counts not
                trial.next_episode += 1
                yield event
            best = self.divergence.blank(trial.best, (self.index, 0))
            done = DesignDone(self.index, trial.kind, trial.design, best, dict(diverged))
            self.index, self.trial = self.index + 1, None
            yield done

    def state_dict(self) -> dict[str, Any]:
        """Return all that the coming events depend on, between two events; see `coim.continuation.state_of`."""
        return state_of(self)

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on as the one that :meth:`state_dict` was read from; see `coim.continuation.restore`."""
        restore(self, state_dict)

    @property
    def updates_per_episode(self) -> int:
        """Of both learners and the ensemble together."""
        model = 0 if self.dynamics is None else self.model_updates
        return self.individual_updates + self.population_updates + model

    def _generators(self, seed: int) -> dict[str, torch.Generator]:
        """One for each reader and writer, so that nothing depends on who comes first; each where its numbers are."""
        seeds = torch.Generator("cpu").manual_seed(seed)
        replay = self.buffers.pop.storage.device
        # The bodies move on the CPU: what they get is drawn there, and is the same wherever the networks are.
        cpu = torch.device("cpu")
        devices: dict[str, torch.device] = {"actions": cpu, "dream": self.device, "designs": cpu}
        devices |= dict.fromkeys(("individual", "population", "model"), replay)
        if self.governor is not None:  # last, so that the numbers of all others stay what they are without it
            devices |= dict.fromkeys(("imagined states", "imagined population", "imagined individual"), replay)
        return {
            name: torch.Generator(device).manual_seed(int(torch.randint(2**62, (), generator=seeds, device="cpu")))
            for name, device in devices.items()
        }

    def _episodes_of(self, index: int) -> int:
        return self.first_episodes if index < len(self.first_designs) else self.episodes

    def _run_and_learn(self, kind: Kind, design: Tensor, episode: int) -> EpisodeDone:
        seconds: dict[str, float] = {}
        place, blank = (self.index, episode), self.divergence.blank
        with booked(seconds, "episode"):
            # Collect experience for the current design with pi_Ind.
            with booked(seconds, "collect"):
                rows = run_episode(self.env, self.individual.policy, design=design, rng=self.rngs["actions"])
                self.buffers.ind.extend(rows)
                self.buffers.pop.extend(rows)
            # Refresh Replay_Art with p~ and pi_Pop; stale rows would come from an older policy and model.
            with booked(seconds, "imagine"):
                metrics = self._observe(rows, episode) | self._refresh_imagined()
            self.buffers.s0.extend(rows[:1])
            self.divergence.remember()
            metrics |= self._learn(seconds)
            self.divergence.contain(metrics, place)
            with booked(seconds, "evaluate"):
                evaluation = run_episode(self.evaluation_env, self.individual.policy, design=design, deterministic=True)
        self.env_steps += len(rows)
        metrics["broken"] = sum(
            found["next", "terminated"].sum(0).squeeze(-1).cpu().float() for found in (rows, evaluation)
        )
        return EpisodeDone(
            index=self.index,
            kind=kind,
            episode=episode,
            design=design,
            training_return=blank(episode_return(rows), place),
            evaluation_return=blank(episode_return(evaluation), place),
            env_steps=self.env_steps,
            imagined=len(self.buffers.art),
            metrics={name: blank(value, place) for name, value in metrics.items()},
            seconds=seconds,
            diverged=dict(self.divergence.places),
        )

    def _observe(self, rows: TensorDictBase, episode: int) -> Means:
        """Scale the ensemble by the new rows, and say how well it foresaw them before it learns from them."""
        if self.dynamics is None:
            return {}
        self.dynamics.observe(rows)
        error = self.dynamics.error(rows).cpu()
        if self.governor is not None:
            self.governor.observe(error, first=episode == 0)
        return {"model_error": error}

    def _refresh_imagined(self) -> Means:
        """Fill Replay_Art anew, if anything is imagined; see `coim.imagined_replay`."""
        if self.imagined is None:
            self.buffers.art.empty()
            return {}
        rng, states_rng = self.rngs["dream"], self.rngs.get("imagined states")
        metrics = self.imagined.refresh(
            self.buffers.pop, self.population.policy, self.imagined_rows, rng=rng, states_rng=states_rng
        )
        if self.governor is not None:
            metrics["imagined_share"] = self.governor.shares(self.population_parts.imagined / self.batch_size)
        return metrics

    def _rows_to_draw(self) -> int:
        """Imagined rows that the updates after one episode will draw, and at least one."""
        population = self.population_updates * self.population_parts.imagined
        return max(1, population + self.individual_updates * self.individual_parts.imagined)

    def _learn(self, seconds: dict[str, float]) -> Means:
        """Train pi_Ind and Q_Ind, then pi_Pop and Q_Pop, then the ensemble; or the first beside the other two."""

        def population_and_model() -> Means:
            means = self._train("population", self.population, self.population_parts, self.population_updates, seconds)
            if self.dynamics is None:
                return means
            parts = batch_parts(self.batch_size)
            return means | self._train("model", self.dynamics, parts, self.model_updates, seconds)

        def individual() -> Means:
            return self._train("individual", self.individual, self.individual_parts, self.individual_updates, seconds)

        if self._beside is None:
            return individual() | population_and_model()
        beside = self._beside.submit(population_and_model)
        try:
            return individual() | beside.result()
        except BaseException:
            self._abandoned.set()  # a process that is told to end would wait for the other thread
            raise

    def _train(
        self,
        name: str,
        learner: SACLearner | DynamicsLearner,
        parts: BatchParts,
        updates: int,
        seconds: dict[str, float],
    ) -> Means:
        """Draw batches by their parts and learn from them; returns the mean of each metric, ``[K]``."""
        own = self.buffers.ind if name == "individual" else self.buffers.pop
        # Governed, a batch is drawn as the model-free baseline draws it, and imagined rows are put into it afterwards.
        governed = parts.imagined if self.governor is not None else 0
        sources = (
            (own, parts.own + governed),
            (self.buffers.pop, parts.other),
            (self.buffers.art, parts.imagined - governed),
        )
        means: Means = {}
        with booked(seconds, f"train {name}"):
            for done in range(0, updates, UPDATES_PER_SAMPLE):
                if self._abandoned.is_set():
                    raise RuntimeError("an update failed or was interrupted; go on from a state_dict of before")
                count = min(UPDATES_PER_SAMPLE, updates - done)
                batches = sample_mixture(sources, count, imagined=self.buffers.art, rng=self.rngs[name])
                if governed and self.imagined is not None:
                    rng = self.rngs[f"imagined {name}"]
                    batches = self.imagined.put_into(batches, governed / self.batch_size, rng=rng)
                for key, value in learner.update(batches).items():
                    means[f"{name}/{key}"] = means.get(f"{name}/{key}", 0.0) + value.cpu() * (count / updates)
        return means


def _governor(dynamics: DynamicsLearner | None, dream: WorldModelEnv | None) -> Governor:
    """A governor of the model that is learnt."""
    if dynamics is None or dream is None:
        raise ValueError(
            "what is imagined is governed by the errors of the model that is learnt; give dynamics and dream"
        )
    return Governor(dynamics.ensemble)


def episode_return(rows: TensorDictBase) -> Tensor:
    """Undiscounted return of an episode ``[T, K]``, per run ``[K]``, on the CPU."""
    return rows["next", "reward"].sum(0).squeeze(-1).cpu()
