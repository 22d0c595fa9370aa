"""From settings to a finished run: build the parts, follow Algorithm 1, write what happens."""

from __future__ import annotations

import random
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from coim import (
    Buffers,
    CoAdaptation,
    DesignChosen,
    DynamicsLearner,
    EpisodeDone,
    GradientSearch,
    KnownDesigns,
    MorphEnv,
    NetworkSizes,
    NoisyDesigns,
    ParticleSwarm,
    RandomDesigns,
    SACLearner,
    SimulatorDynamics,
    WorldModelEnv,
)
from coim.batches import batch_parts
from coim.designs import DesignGenerator, DesignSearch
from recipes.best_policies import BestPolicies
from recipes.checkpoint import Checkpoints, refuse_lost_checkpoints
from recipes.interrupt import Stopped, locked, on_command_line, says_read_only, stopping_at_once
from recipes.machine import available_cores, check_compiler, checked_device, prepare
from recipes.progress import Progress
from recipes.report import write_report
from recipes.reporting.pictures import draw_run
from recipes.results import Results, default_folder, refuse_filled, versions
from recipes.settings import Settings, episodes_of, parse, read_config
from recipes.wandb_log import WandbLog

SIMULATED_ROWS = 250  # bodies that the simulator sets up and steps at once where it takes the ensemble's place


def main(body: type[MorphEnv], name: str, arguments: Sequence[str] | None = None) -> None:
    """Command line of one environment's recipe."""
    program, description = f"python -m recipes.{name}", f"Co-adapt {body.__name__}: body and controller together."
    with on_command_line(own_process=arguments is None):
        run(body, name, parse(program, description, arguments))


def run(body: type[MorphEnv], name: str, settings: Settings) -> Path:
    """Train, and leave a folder with the settings, the numbers and a picture; see `train`."""

    def make(folder: Path, threads: int, side_by_side: bool) -> CoAdaptation:
        return build(body, settings, threads=threads, side_by_side=side_by_side)

    return train(body, name, settings, make, again=f"python -m recipes.{name} --resume")


def train(
    body: type[MorphEnv],
    name: str,
    settings: Settings,
    make: Callable[[Path, int, bool], Any],
    *,
    again: str,
    finish: Callable[[Any, Path], None] | None = None,
) -> Path:
    """Follow Algorithm 1 in a folder of its own, which can be gone on with after any end.

    Args:
        body: the environment.
        name: of the environment, the first part of the folder's name.
        settings: everything else; ``resume`` names the folder of a run to go on with.
        make: a `CoAdaptation`, or what can stand for one, from its folder, its threads and whether its learners go
            side by side.
        again: the line that goes on with a run, but for its folder.
        finish: what is left to do with an algorithm that is through.

    Returns:
        The folder.

    Raises:
        ValueError: if settings contradict each other, the folder or this machine.
        OSError: if the folder cannot be written to.
        SystemExit: on Ctrl-C or SIGTERM, after the line that goes on with the run.
    """
    threads = settings.threads or available_cores()
    side_by_side = prepare(threads, checked_device(settings.device))
    folder = settings.resume or settings.out or default_folder(name, settings)
    if settings.resume is None:
        refuse_filled(folder)
    else:
        check_origin(folder, name)
        refuse_lost_checkpoints(folder)
    if settings.compile:
        check_compiler()
    algorithm = make(folder, threads, side_by_side)
    if not settings.quiet:
        learners = "learners side by side, one thread each" if side_by_side else "one thread"
        how = "compiled in the first episode" if settings.compile else "not compiled"
        print(f"{name}: {settings.num_runs} run(s) on {settings.device}, {learners}, {how} -> {folder}")
    again = f"to go on: {again} {folder}"
    with locked(folder):
        try:
            with stopping_at_once():
                follow(algorithm, folder, name, settings)
                if finish is not None:
                    finish(algorithm, folder)
        except Stopped as stop:
            begun = (folder / "config.json").is_file()
            print(f"\n{stop}; {again if begun else 'nothing was written yet, start it again'}", file=sys.stderr)
            sys.exit(128 + stop.signum)
        except OSError as error:  # a full disk, most likely
            first = f"make {folder} writable; " if says_read_only(error) else ""
            raise OSError(f"{error}; {first}{again}") from error
    picture, report = draw_run(folder, body), write_report([folder], body=body)
    if not settings.quiet:
        print(f"picture: {picture}\nreport: {report}")
    return folder


def follow(algorithm: CoAdaptation, folder: Path, name: str, settings: Settings) -> None:
    """Iterate, from the start or from the last checkpoint: write, show and log each event, and save between them."""
    best = BestPolicies(folder, algorithm)
    checkpoints = Checkpoints(folder, algorithm, best)
    notes = checkpoints.load() if settings.resume is not None else None
    trial = algorithm.trial
    results = Results(folder, name, settings, algorithm.env.design_spec.shape[0], notes=notes)
    progress = Progress(
        num_designs=settings.num_designs,
        total_episodes=sum(episodes_of(settings, index) for index in range(settings.num_designs)),
        updates=algorithm.updates_per_episode,
        imagined_share=algorithm.population_parts.imagined / settings.batch_size,
        done=algorithm.env_steps // settings.episode_steps,
        best=float("-inf") if trial is None else float(trial.best[trial.best.isfinite()].mean().nan_to_num(-torch.inf)),
        quiet=settings.quiet,
    )
    log = None if settings.wandb == "off" else WandbLog(folder, name, settings.wandb, quiet=settings.quiet)
    started = time.perf_counter()
    for event in algorithm:
        results.write(event, time.perf_counter() - started)
        best.follow(event)
        progress.show(event)
        if log is not None:
            log.write(event)
        # A chosen design is saved too: the swarm takes as long as an episode.
        chosen = isinstance(event, DesignChosen)
        if chosen or (isinstance(event, EpisodeDone) and (event.episode + 1) % settings.checkpoint_every == 0):
            checkpoints.save(results.notes())
    progress.end()
    if log is not None:
        log.close()
    if algorithm.divergence.everywhere:
        print("every run has diverged: there is nothing left to learn, and this ends here", file=sys.stderr)
    if not settings.quiet:
        print(results.table())


def check_origin(folder: Path, name: str) -> None:
    """Refuse a run of another environment, and warn of other versions than those that it began with."""
    config = read_config(folder)
    if config["environment"] != name:
        raise ValueError(f"{folder} holds a run of {config['environment']}: python -m recipes.{config['environment']}")
    present = versions()
    for package, version in config["versions"].items():
        if present.get(package) != version:
            now = present.get(package)
            print(f"warning: {package} was {version} and is {now}; the numbers may differ from here", file=sys.stderr)


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

    def learner() -> SACLearner:
        return SACLearner(
            sizes.policy(env).to(device),
            sizes.qvalue(env).to(device),
            alpha=settings.alpha,
            gamma=settings.gamma,
            tau=settings.tau,
            lr=settings.lr,
            mix=settings.mix,
            num_runs=sizes.stacked,
            precision=settings.precision,
            compile=settings.compile,
            seed=next(seeds),
        )

    population, individual = learner(), learner()
    generator = make_generator(env, settings)
    dynamics, dream = None, None
    if generator is not None and settings.dream == "simulator":
        # Its reset noise is never used: the seeds of all other parts stay what they are with an ensemble.
        truth = SimulatorDynamics(body(num_runs=SIMULATED_ROWS, seed=0, num_threads=threads, device=device))
        dream = WorldModelEnv(truth, env, batch_size=env.batch_size)
    elif generator is not None:
        ensemble = sizes.ensemble(env).to(device)
        dynamics = DynamicsLearner(
            ensemble,
            lr=settings.model_lr,
            weight_decay=settings.weight_decay,
            num_runs=sizes.stacked,
            precision=settings.precision,
            compile=settings.compile,
        )
        dream = WorldModelEnv(ensemble, env, batch_size=env.batch_size)
    return CoAdaptation(
        env,
        evaluation_env,
        population=population,
        individual=individual,
        buffers=make_buffers(env, settings, seed=next(seeds)),
        search=make_search(env, settings, seed=next(seeds)),
        first_designs=torch.tensor(
            [settings.first_design] if settings.first_design else body.FIRST_DESIGNS, device=device
        ),
        bodies=settings.bodies,
        dynamics=dynamics,
        dream=dream,
        generator=generator,
        num_designs=settings.num_designs,
        first_episodes=settings.first_episodes,
        episodes=settings.episodes,
        individual_updates=settings.individual_updates,
        population_updates=settings.population_updates,
        model_updates=settings.model_updates,
        batch_size=settings.batch_size,
        imagined_share=settings.imagined_share,
        individual_mix=settings.individual_mix,
        individual_imagined_share=settings.individual_imagined_share,
        num_start_states=settings.num_start_states,
        side_by_side=side_by_side,
        precision=settings.precision,
        seed=next(seeds),
    )


def make_generator(env: MorphEnv, settings: Settings) -> DesignGenerator | None:
    """G by its name on the command line."""
    if settings.designs == "none":
        return None
    if settings.designs == "noisy":
        return NoisyDesigns(env.design_spec, sigma=settings.sigma)
    return KnownDesigns() if settings.designs == "known" else RandomDesigns(env.design_spec)


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
    episodes = [episodes_of(settings, index) for index in range(settings.num_designs)] or [1]
    population = batch_parts(settings.batch_size, imagined=settings.imagined_share)
    individual = batch_parts(
        settings.batch_size, imagined=settings.individual_imagined_share, other=settings.individual_mix
    )
    imagined = settings.population_updates * population.imagined + settings.individual_updates * individual.imagined
    return Buffers.for_env(
        env,
        pop_capacity=sum(episodes) * settings.episode_steps,
        ind_capacity=max(episodes) * settings.episode_steps,
        s0_capacity=sum(episodes),
        art_capacity=max(1, imagined),
        seed=seed,
        device=checked_device(settings.device),
    )
