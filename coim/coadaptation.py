"""Algorithm 1: behaviour, design and dynamics learnt together, one body after the other.

`CoAdaptation` is an iterator over events. It draws nothing, logs nothing and stops when nobody asks for the next event;
networks, bodies, buffers and the choice of bodies are passed in. The second loop of Algorithm 1, design, is
`coim.design_choice`; the updates are `coim.updates`.

Shapes: T steps, K runs, D design.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Algorithm 1, Sec. 5 and 6.1.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from coim.agreement import (
    check_bodies,
    check_buffers,
    check_counts,
    check_governed,
    check_kinds,
    check_learners,
    check_networks,
)
from coim.buffers import Buffers
from coim.design_choice import DesignChoice, Situation
from coim.envs.morph import MorphEnv
from coim.envs.native_episode import library
from coim.episode import run_episode
from coim.events import EpisodeDone, Event
from coim.imagined_replay import ImaginedReplay
from coim.learners.divergence import Divergence
from coim.learners.dynamics import DynamicsLearner
from coim.learners.sac import SACLearner
from coim.position import Position, Trial
from coim.randomness import Stream, restore_generator, stream
from coim.updates import BATCHES, GOVERNED, Means, Name, Training, UpdatePlan, booked


class CoAdaptation:
    """Algorithm 1 as an iterator over events; without ``imagined`` it is the model-free baseline.

    Args:
        env: bodies to train on, K runs in lock-step.
        evaluation_env: bodies of its own for the evaluation episodes, so that evaluating changes nothing in training.
        population: learner that sees all designs.
        individual: learner that sees the current design; starts each design from the population's weights.
        buffers: Replay_Pop, Replay_Ind, Replay_s0 and Replay_Art. They may live on the CPU while the learners are on a
            GPU, which then moves the batches of one call at once.
        design_choice: which body comes next.
        dynamics: learns p~ from Replay_Pop after each episode; None learns none.
        imagined: Replay_Art, how it is refreshed and how much of it is learnt from; None imagines nothing.
        num_designs: M, first designs included.
        first_episodes: episodes on each of the first designs.
        episodes: episodes on every later design.
        updates: how many updates follow an episode, and the rows of their batches; None is the paper's.
        side_by_side: train the individual learner in one thread while another trains the population's and the ensemble.
            They do not depend on each other, and the result is the same to the last bit. For learners on the CPU.
        native_episodes: let the bodies act in native code, see `coim.run_episode`.
        seed: seeds actions, imagination and batches. Actions are drawn on the CPU wherever the networks are: there the
            same seed gives the same first episode.

    Raises:
        ValueError: if a count or a share is out of its range, or the parts do not agree; see `coim.agreement`.
        TypeError: if an environment or the dream is behind transforms, or a part is no such thing at all.
        RuntimeError: if networks were moved after their learner was made, or native code cannot be compiled.

    Note:
        After a caller has stopped at an event, iterating again goes on with what comes next, and so does another
        instance, made alike, that loads the `state_dict`. After an exception within the loop only the latter is sound.

        Evaluation episodes leave no trace in the replay. The predecessor's code also skips training in the first three
        episodes of a design and population training in the first designs; the paper has no such rule.

    Example:
        >>> import torch
        >>> from coim import Buffers, DesignChoice, DesignDone, GradientSearch, HopperMorph, SACLearner, UpdatePlan
        >>> from coim import make_policy, make_qvalue
        >>> env, evaluation_env = (HopperMorph(seed=seed, episode_steps=20) for seed in (0, 1))
        >>> first = torch.tensor([[1.0] * 4, [1.5] * 4])
        >>> algorithm = CoAdaptation(
        ...     env,
        ...     evaluation_env,
        ...     population=SACLearner(make_policy(env), make_qvalue(env), seed=2),
        ...     individual=SACLearner(make_policy(env), make_qvalue(env), seed=3),
        ...     buffers=Buffers.for_env(env, pop_capacity=60, ind_capacity=20, s0_capacity=3, art_capacity=1, seed=4),
        ...     design_choice=DesignChoice(env.design_spec, first, search=GradientSearch(env.design_spec, seed=5)),
        ...     num_designs=3,
        ...     first_episodes=1,
        ...     episodes=1,
        ...     updates=UpdatePlan(individual_updates=2, population_updates=1),
        ... )
        >>> [event.kind for event in algorithm if isinstance(event, DesignDone)]
        ['first', 'first', 'optimised']
    """

    def __init__(
        self,
        env: MorphEnv,
        evaluation_env: MorphEnv,
        *,
        population: SACLearner,
        individual: SACLearner,
        buffers: Buffers,
        design_choice: DesignChoice,
        dynamics: DynamicsLearner | None = None,
        imagined: ImaginedReplay | None = None,
        num_designs: int = 55,
        first_episodes: int = 300,
        episodes: int = 100,
        updates: UpdatePlan | None = None,
        side_by_side: bool = False,
        native_episodes: bool = False,
        seed: int = 0,
    ) -> None:
        check_counts({"num_designs": num_designs, "first_episodes": first_episodes, "episodes": episodes}, {})
        check_kinds(
            {
                "population": (population, SACLearner),
                "individual": (individual, SACLearner),
                "buffers": (buffers, Buffers),
                "design_choice": (design_choice, DesignChoice),
                "dynamics": (dynamics, DynamicsLearner, type(None)),
                "imagined": (imagined, ImaginedReplay, type(None)),
            }
        )
        check_bodies(env, evaluation_env)
        self.device = check_learners(env, population, individual, dynamics, side_by_side=side_by_side)
        check_networks(env, population, individual, dynamics)
        design_choice.check_fits(env)
        plan = updates or UpdatePlan()
        if imagined is None:
            plan = plan.without_imagination()
        else:
            imagined.check_fits(env, buffers.art, dynamics, design_choice.first_designs)
            check_governed(imagined.governor, population, individual)
        check_buffers(env, buffers, imagined_rows=plan.imagined_rows)
        self.env, self.evaluation_env, self.buffers, self.design_choice = env, evaluation_env, buffers, design_choice
        self.population, self.individual, self.dynamics, self.imagined = population, individual, dynamics, imagined
        self.num_designs, self.first_episodes, self.episodes = num_designs, first_episodes, episodes
        learners: dict[Name, SACLearner | DynamicsLearner] = {"individual": individual, "population": population}
        if dynamics is not None:
            learners["model"] = dynamics
        # Actions are drawn on the CPU, where the bodies move.
        devices: dict[Stream, torch.device] = {"actions": torch.device("cpu"), "dream": self.device}
        devices |= dict.fromkeys(BATCHES, buffers.pop.storage.device)
        if imagined is not None and imagined.governor is not None:
            devices |= dict.fromkeys(GOVERNED, buffers.pop.storage.device)
        self.rngs = {name: stream(name, seed, device) for name, device in devices.items()}
        self.native_episodes = native_episodes
        if native_episodes:
            library()  # what cannot be compiled is said now, and not after the first body is chosen
        self.training = Training(plan, buffers, learners, self.rngs, imagined=imagined, side_by_side=side_by_side)
        self.divergence = Divergence(env.batch_size.numel(), [*learners.values()])
        self.position = Position()

    def __iter__(self) -> Iterator[Event]:
        # The position changes before an event. A caller that stops there, and goes on here or in another process with
        # the state_dict, gets what would have come next.
        at = self.position
        while at.index < self.num_designs and (at.trial is not None or not self.divergence.everywhere):
            trial = at.trial
            if trial is None:
                situation = Situation(
                    at.index, self.env, self.population, self.buffers, at.tried, self.divergence.places
                )
                chosen = self.design_choice.choose(situation)
                trial = at.begin(chosen)
                yield chosen
            if trial.next_episode == 0:
                # Without the population's weights the individual networks would start from the last body's gait.
                self.individual.start_from(self.population)
                self.buffers.ind.empty()
                self._refresh_imagined()
            while trial.next_episode < self.episodes_of(at.index) and not self.divergence.everywhere:
                event = self._run_and_learn(trial)
                trial.best = torch.fmax(trial.best, event.evaluation_return.cpu())  # NaN from a diverged run is ignored
                trial.next_episode += 1
                yield event
            best = self.divergence.blank(trial.best, (at.index, 0))
            yield at.end(trial, best, self.divergence.places)

    @property
    def updates_per_episode(self) -> int:
        """Updates of all learners after an episode."""
        return self.training.updates_per_episode

    def episodes_of(self, index: int) -> int:
        """Episodes on a design, by its index from 0."""
        return self.first_episodes if index < len(self.design_choice.first_designs) else self.episodes

    def _run_and_learn(self, trial: Trial) -> EpisodeDone:
        """One training episode, the updates after it, and one evaluation episode."""
        seconds: dict[str, float] = {}
        design, place, blank = trial.design, (self.position.index, trial.next_episode), self.divergence.blank
        with booked(seconds, "episode"):
            # Collect experience for the current design with pi_Ind.
            with booked(seconds, "collect"):
                rows = self._episode(self.env, design, rng=self.rngs["actions"])
                self.buffers.ind.extend(rows)
                self.buffers.pop.extend(rows)
            # Refresh Replay_Art with p~ and pi_Pop; stale rows would come from an older policy and model.
            with booked(seconds, "imagine"):
                metrics = self._observe(rows, first=trial.next_episode == 0) | self._refresh_imagined()
            self.buffers.s0.extend(rows[:1])
            # Train pi_Ind and Q_Ind, pi_Pop and Q_Pop, and p~.
            self.divergence.remember()
            metrics |= self.training.after_episode(seconds)
            self.divergence.contain(metrics, place)
            with booked(seconds, "evaluate"):
                evaluation = self._episode(self.evaluation_env, design, deterministic=True)
        self.position.env_steps += len(rows)
        broken = [found["next", "terminated"].sum(0).squeeze(-1).cpu().float() for found in (rows, evaluation)]
        metrics["broken"] = broken[0] + broken[1]
        return EpisodeDone(
            index=self.position.index,
            kind=trial.kind,
            episode=trial.next_episode,
            design=design.clone(),
            training_return=blank(episode_return(rows), place),
            evaluation_return=blank(episode_return(evaluation), place),
            env_steps=self.position.env_steps,
            imagined=len(self.buffers.art),
            metrics={name: blank(value, place) for name, value in metrics.items()},
            seconds=seconds,
            diverged=dict(self.divergence.places),
        )

    def _episode(self, env: MorphEnv, design: Tensor, **how: Any) -> TensorDict:
        """An episode of the current body under pi_Ind."""
        return run_episode(env, self.individual.policy, design=design, native=self.native_episodes, **how)

    def _observe(self, rows: TensorDictBase, *, first: bool) -> Means:
        """Scale the ensemble by the new rows, and say how well it foresaw them before it learns from them."""
        if self.dynamics is None:
            return {}
        self.dynamics.observe(rows)
        error = self.dynamics.error(rows).cpu()
        if self.imagined is not None and self.imagined.governor is not None:
            self.imagined.governor.observe(error, first=first)
        return {"model_error": error}

    def _refresh_imagined(self) -> Means:
        """Replace Replay_Art: states of Replay_Pop, designs of G, actions of pi_Pop, next states of p~."""
        if self.imagined is None:
            self.buffers.art.empty()
            return {}
        plan, rng, states_rng = self.training.plan, self.rngs["dream"], self.rngs.get("imagined states")
        metrics = self.imagined.refresh(
            self.buffers.pop, self.population.policy, plan.imagined_rows, rng=rng, states_rng=states_rng
        )
        if self.imagined.governor is not None:
            most = max(plan.rows(name).imagined for name in ("population", "individual")) / plan.batch_size
            metrics["imagined_share"] = self.imagined.governor.shares(most)
        return metrics

    def state_dict(self) -> dict[str, Any]:
        """Return all that the coming events depend on, between two events.

        Numbers, strings, tensors and dicts of them, as `torch.load` reads them with ``weights_only``. Tensors are not
        copied: save or copy them before the next event.

        Note:
            Torch's, numpy's and Python's global generators are not in it. Nothing here draws from them, but a foreign
            policy or search may.
        """
        return {
            "position": {**self.position.state_dict(), "diverged": dict(self.divergence.places)},
            "rngs": {name: rng.get_state() for name, rng in self.rngs.items()},
            "env": self.env.get_simulation_state().to_dict(),
            "evaluation_env": self.evaluation_env.get_simulation_state().to_dict(),
            "population": self.population.state_dict(),
            "individual": self.individual.state_dict(),
            "dynamics": None if self.dynamics is None else self.dynamics.state_dict(),
            "imagined": None if self.imagined is None else self.imagined.state_dict(),
            "dream": None if self.imagined is None else self.imagined.dream.rng.get_state(),
            "design_choice": self.design_choice.state_dict(),
            "buffers": self.buffers.state_dict(),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on, event by event and bit by bit, as the one that :meth:`state_dict` was read from.

        Args:
            state_dict: of an algorithm made of the same parts with the same settings; only ``num_designs`` and the
                number of threads may differ. It is left as it is, and nothing of it is shared.

        Raises:
            ValueError: if the two do not have the same parts or the same sizes.
        """
        for part in ("dynamics", "dream"):
            own = self.dynamics if part == "dynamics" else self.imagined
            if (state_dict[part] is None) != (own is None):
                raise ValueError(
                    f"one of the state and the algorithm has a {part} and the other has none; make it alike"
                )
        state = {**state_dict}
        if "design_choice" not in state:  # of a version whose algorithm searched and drew the random designs itself
            state["design_choice"] = {"search": state["search"], "rng": state["rngs"]["designs"]}
        self.buffers.check_state(state["buffers"])
        if self.imagined is not None:
            self.imagined.load_state_dict(state.get("imagined"))
            restore_generator(self.imagined.dream.rng, state["dream"])
        for part in ("population", "individual", "dynamics", "design_choice", "buffers"):
            if (own := getattr(self, part)) is not None:
                own.load_state_dict(state[part])
        for name in ("env", "evaluation_env"):
            getattr(self, name).set_simulation_state(TensorDict(state[name], state[name]["design"].shape[:1]))
        for name, rng in self.rngs.items():
            restore_generator(rng, state["rngs"][name])
        self.position.load_state_dict(state["position"], device=self.env.device)
        self.divergence.places = dict(state["position"]["diverged"])


def episode_return(rows: TensorDictBase) -> Tensor:
    """Undiscounted return of an episode ``[T, K]``, per run ``[K]``, on the CPU."""
    return rows["next", "reward"].sum(0).squeeze(-1).cpu()
