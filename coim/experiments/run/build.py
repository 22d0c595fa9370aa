"""The parts of Algorithm 1, made from settings and put together."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import torch

from coim.buffers import Buffers
from coim.coadaptation import CoAdaptation
from coim.design_choice import DesignChoice
from coim.designs import (
    DesignGenerator,
    DesignSearch,
    GradientSearch,
    KnownDesigns,
    NoisyDesigns,
    ParticleSwarm,
    RandomDesigns,
)
from coim.envs import MorphEnv, SimulatorDynamics, WorldModelEnv
from coim.experiments.run.machine import checked_device
from coim.experiments.run.settings import Settings
from coim.governor import Governor
from coim.imagined_replay import ImaginedReplay
from coim.learners.dynamics import DynamicsLearner
from coim.learners.sac import SACLearner
from coim.models import NetworkSizes
from coim.updates import UpdatePlan

SIMULATED_ROWS = 250  # bodies that the simulator sets up and steps at once where it takes the ensemble's place


def build(body: type[MorphEnv], settings: Settings, *, threads: int = 1, side_by_side: bool = False) -> CoAdaptation:
    """Make the parts of Algorithm 1 and put them together."""
    device = checked_device(settings.device)
    # Streams of one seed that have nothing in common, nor with those of the next seed.
    seeds = iter(np.random.SeedSequence(settings.seed).generate_state(8).tolist())
    torch.manual_seed(next(seeds))  # initial weights
    # Nothing of ours draws from these two. What somebody plugs in may, and shall repeat as well.
    random.seed(settings.seed)
    np.random.seed(settings.seed % 2**32)  # noqa: NPY002

    def bodies() -> MorphEnv:
        return body(
            num_runs=settings.num_runs,
            task=settings.task,
            episode_steps=settings.episode_steps,
            seed=next(seeds),
            num_threads=threads,
            device=device,
        )

    env, evaluation_env = bodies(), bodies()
    sizes = NetworkSizes.among(vars(settings))
    population, individual = (make_learner(env, sizes, settings, seed=next(seeds)) for _ in range(2))
    dynamics, dream = None, None
    generator = make_generator(env, settings)
    if generator is not None:
        dynamics, dream = make_dream(env, sizes, settings, threads=threads)
    buffers = make_buffers(env, settings, seed=next(seeds))
    search = make_search(env, settings, seed=next(seeds))
    imagined = None
    if generator is not None and dream is not None:
        imagined = ImaginedReplay(
            buffers.art,
            dream,
            generator,
            states_are=settings.imagined_states,
            anchored=settings.anchored,
            actions=settings.imagined_actions,
            governor=Governor(dynamics.ensemble) if settings.governed and dynamics is not None else None,
        )
    seed = next(seeds)
    return CoAdaptation(
        env,
        evaluation_env,
        population=population,
        individual=individual,
        buffers=buffers,
        design_choice=make_choice(env, settings, search, seed=seed),
        dynamics=dynamics,
        imagined=imagined,
        num_designs=settings.num_designs,
        first_episodes=settings.first_episodes,
        episodes=settings.episodes,
        updates=update_plan(settings),
        side_by_side=side_by_side,
        native_episodes=settings.native_episodes,
        seed=seed,
    )


def make_choice(env: MorphEnv, settings: Settings, search: DesignSearch, *, seed: int) -> DesignChoice:
    """Which body comes next, by its name on the command line.

    Raises:
        ValueError: if BoTorch is asked for and not installed.
    """
    first = torch.tensor(first_designs(type(env), settings), dtype=torch.float32, device=env.device)
    given: dict[str, Any] = {
        "search": search,
        "bodies": settings.bodies,
        "num_start_states": settings.num_start_states,
        "value_states": settings.value_states,
        "value_over": settings.value_over,
        "reach": settings.reach,
        "widening": settings.widening,
        "precision": settings.precision,
        "seed": seed,
    }
    if settings.chosen_by == "value":
        return DesignChoice(env.design_spec, first, **given)
    try:
        from coim.posterior_choice import PosteriorChoice
    except ImportError as error:
        raise ValueError(f"{error}, or choose bodies by value") from error
    return PosteriorChoice(env.design_spec, first, critic=settings.chosen_by == "posterior", **given)


def update_plan(settings: Settings) -> UpdatePlan:
    """How much is learnt after each episode, from the settings of the same names."""
    return UpdatePlan(**{field.name: getattr(settings, field.name) for field in fields(UpdatePlan)})


def make_learner(env: MorphEnv, sizes: NetworkSizes, settings: Settings, *, seed: int) -> SACLearner:
    """Policy and critics with their optimiser."""
    return SACLearner(
        sizes.policy(env).to(env.device),
        sizes.qvalue(env).to(env.device),
        alpha=settings.alpha,
        gamma=settings.gamma,
        tau=settings.tau,
        lr=settings.lr,
        mix=settings.mix,
        num_runs=sizes.stacked,
        precision=settings.precision,
        compile=settings.compile,
        seed=seed,
    )


def make_dream(
    env: MorphEnv, sizes: NetworkSizes, settings: Settings, *, threads: int
) -> tuple[DynamicsLearner | None, WorldModelEnv]:
    """Where transitions are imagined, and the learner of p~ unless the simulator itself imagines."""
    if settings.dream == "simulator":
        # Its reset noise is never used: the seeds of all other parts stay what they are with an ensemble.
        truth = SimulatorDynamics(type(env)(num_runs=SIMULATED_ROWS, seed=0, num_threads=threads, device=env.device))
        return None, WorldModelEnv(truth, env, batch_size=env.batch_size)
    ensemble = sizes.ensemble(env).to(env.device)
    learner = DynamicsLearner(
        ensemble,
        lr=settings.model_lr,
        weight_decay=settings.weight_decay,
        num_runs=sizes.stacked,
        precision=settings.precision,
        compile=settings.compile,
    )
    return learner, WorldModelEnv(ensemble, env, batch_size=env.batch_size)


def first_designs(body: type[MorphEnv], settings: Settings) -> Sequence[Sequence[float]] | list[list[list[float]]]:
    """Bodies that every run tries first: those of the environment, or the one that is asked for, or one for each run.

    Returns:
        ``[I][D]``, or ``[1][K][D]`` where each run has its own.

    Raises:
        ValueError: if there are neither as many numbers as one design has nor as many as one for each run.
    """
    asked, size = settings.first_design, body.DESIGN_SIZE
    if len(asked) not in (0, size, size * settings.num_runs):
        fleet = settings.num_runs > 1
        each = f", or {size * settings.num_runs} for a design of each of {settings.num_runs} runs" if fleet else ""
        raise ValueError(
            f"--first-design has {len(asked)} number(s), a design of this body has {size}; give {size}{each}"
        )
    if len(asked) > size and len(asked) == size * settings.num_runs:
        return [[list(asked[i : i + size]) for i in range(0, len(asked), size)]]
    return [asked] if asked else body.FIRST_DESIGNS


def episodes_of_designs(body: type[MorphEnv], settings: Settings) -> list[int]:
    """Training episodes of each design."""
    num_first = min(len(first_designs(body, settings)), settings.num_designs)
    return [settings.first_episodes] * num_first + [settings.episodes] * (settings.num_designs - num_first)


def make_generator(env: MorphEnv, settings: Settings) -> DesignGenerator | None:
    """G by its name on the command line."""
    if settings.imagine == "none":
        return None
    if settings.imagine == "noisy":
        return NoisyDesigns(env.design_spec, sigma=settings.sigma)
    return KnownDesigns() if settings.imagine == "known" else RandomDesigns(env.design_spec)


def make_search(env: MorphEnv, settings: Settings, *, seed: int) -> DesignSearch:
    """What maximises Eq. 5, by its name on the command line."""
    if settings.search == "gradient":
        return GradientSearch(env.design_spec, seed=seed)
    return ParticleSwarm(
        env.design_spec,
        num_particles=settings.num_particles,
        num_iterations=settings.num_iterations,
        bounds=settings.swarm_bounds,
        seed=seed,
    )


def make_buffers(env: MorphEnv, settings: Settings, *, seed: int) -> Buffers:
    """Four buffers that can hold everything this run will ever put into them."""
    episodes = episodes_of_designs(type(env), settings)
    return Buffers.for_env(
        env,
        pop_capacity=sum(episodes) * settings.episode_steps,
        ind_capacity=max(episodes) * settings.episode_steps,
        s0_capacity=sum(episodes),
        art_capacity=update_plan(settings).imagined_rows,
        seed=seed,
        device=checked_device("cpu" if settings.replay_device == "cpu" else settings.device),
    )
