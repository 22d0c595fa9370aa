"""From settings to a finished run: follow Algorithm 1 and write what happens."""

from __future__ import annotations

import shlex
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from coim.coadaptation import CoAdaptation
from coim.envs import MorphEnv
from coim.events import DesignChosen, EpisodeDone
from coim.experiments.report.run_report import write_report
from coim.experiments.report.summary_png import draw_run
from coim.experiments.run.atomic_write import says_full
from coim.experiments.run.best_policies import BestPolicies
from coim.experiments.run.build import build
from coim.experiments.run.checkpoint import Checkpoints
from coim.experiments.run.command_line import parse
from coim.experiments.run.followed import Followed, FollowedT
from coim.experiments.run.forecast import Forecast, work_of
from coim.experiments.run.interrupt import (
    Stopped,
    locked,
    on_command_line,
    says_read_only,
    sentence_of,
    stopping_at_once,
)
from coim.experiments.run.last_words import last_words
from coim.experiments.run.machine import (
    available_cores,
    check_compiler,
    check_logger,
    check_native_code,
    checked_device,
    folder_of_compiled_code,
    prepare,
    words_of,
)
from coim.experiments.run.progress import Progress
from coim.experiments.run.results import Results, folder_of
from coim.experiments.run.resume import begin_or_resume
from coim.experiments.run.run_log import FORMERLY, RunLog
from coim.experiments.run.settings import QUICK, Settings, option
from coim.objectives.native_gradients import UP_TO


def main(body: type[MorphEnv], name: str, arguments: Sequence[str] | None = None) -> None:
    """Command line of one environment's recipe."""
    program, description = f"coim run {name}", f"Co-adapt {body.__name__}: body and controller together."
    with on_command_line(own_process=arguments is None):
        run(body, name, parse(program, description, arguments))


def run(body: type[MorphEnv], name: str, settings: Settings) -> Path:
    """Train, and leave a folder with the settings, the numbers and a picture; see `train`."""

    def make(folder: Path, threads: int, side_by_side: bool) -> CoAdaptation:
        return build(body, settings, threads=threads, side_by_side=side_by_side)

    return train(body, name, settings, make, again="coim resume")


def train(
    body: type[MorphEnv],
    name: str,
    settings: Settings,
    make: Callable[[Path, int, bool], FollowedT],
    *,
    again: str,
    finish: Callable[[FollowedT, Path], None] | None = None,
) -> Path:
    """Follow Algorithm 1 in a folder of its own, which can be gone on with after any end.

    Args:
        body: the environment.
        name: the environment's name, the first part of the folder's name.
        settings: everything else; ``resume`` names the folder of a run to go on with.
        make: makes the algorithm from its folder, its threads and whether its learners go side by side.
        again: the command that goes on with a run, without its folder.
        finish: called when the algorithm has ended, with its folder.

    Returns:
        The folder.

    Raises:
        ValueError: if settings contradict each other, the folder or this machine.
        OSError: if the folder cannot be written to.
        SystemExit: on Ctrl-C or SIGTERM, after the line that goes on with the run.
    """
    threads = settings.threads or available_cores()
    side_by_side = prepare(threads, checked_device(settings.device))
    products = begin_or_resume(name, settings)
    native, traced = has_native_gradients(settings), settings.compile and torch.device(settings.device).type != "cpu"
    needed = {"compile": native or traced, "native_episodes": settings.native_episodes}
    if needing := [option(f"no_{name}") for name, asked in needed.items() if asked]:
        check_compiler(" ".join(needing), makes=traced)
    check_native_code(gradients=native, episodes=settings.native_episodes)
    check_logger(settings.log)
    with folder_of(name, settings) as folder:
        algorithm = make(folder, threads, side_by_side)
    if not settings.quiet:
        learners = "learners side by side, one thread each" if side_by_side else "one thread"
        on_cpu = torch.device(settings.device).type == "cpu"
        by = f", products by {words_of(products)}" if on_cpu else ""
        how = how_gradients_are_computed(algorithm, settings)
        print(f"{name}: {settings.num_runs} run(s) on {settings.device}, {learners}, {how}{by} -> {folder}")
        if on_cpu and settings.precision == "bfloat16" and products.bfloat16 == "emulated":
            print("bfloat16 is emulated by float32 products here, which is slower than --precision float32")
    again = f"to go on: {again} {shlex.quote(str(folder))}"
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
        except OSError as error:
            first = f"make {folder} writable; " if says_read_only(error) else ""
            raise OSError(f"{sentence_of(error)}; {first}{again}") from error
        except RuntimeError as error:  # of Inductor, with its compiler's words
            if not says_full(error):
                raise
            places = " and ".join(dict.fromkeys([str(folder_of_compiled_code()), tempfile.gettempdir()]))
            raise OSError(f"disk full: nothing can be compiled in {places}; make room there; {again}") from error
    try:
        picture, report = draw_run(folder, body), write_report([folder], body=body)
    except OSError as error:
        raise OSError(f"{error}; the run is over, and its page is made by coim report {folder}") from error
    if not settings.quiet:
        print("\n".join([f"picture: {picture}", f"report: {report}", *last_words(folder, name, body, settings)]))
    return folder


def has_native_gradients(settings: Settings) -> bool:
    """Whether a run computes gradients in native code, of policy and critics or of a model."""
    if not settings.compile or torch.device(settings.device).type != "cpu" or settings.precision != "float32":
        return False
    learns_a_model = settings.imagine != "none" and settings.dream == "ensemble"
    return min(max(cells) for cells in (settings.num_cells, *[settings.model_cells] * learns_a_model)) <= UP_TO


def how_gradients_are_computed(algorithm: Followed, settings: Settings) -> str:
    """A few words for the first line of a run."""
    if settings.compile and torch.device(settings.device).type != "cpu":
        return "compiled in the first episode"
    learners = algorithm.training.learners
    native = [name for name, learner in learners.items() if learner.native]
    if not native:
        return "not compiled"
    if len(native) == len(learners):
        return "native gradients"
    return f"native gradients of {'the model' if 'model' in native else 'policy and critics'}"


def follow(algorithm: Followed, folder: Path, name: str, settings: Settings) -> None:
    """Iterate, from the start or from the last checkpoint: write, show and log each event, and save between them."""
    best = BestPolicies(folder, algorithm)
    checkpoints = Checkpoints(folder, algorithm, best)
    notes = checkpoints.load() if settings.resume is not None else None
    trial = algorithm.position.trial
    names = type(algorithm.env).design_names()
    results = Results(folder, name, settings, names, notes=notes)
    progress = Progress(
        num_designs=settings.num_designs,
        forecast=forecast_of(algorithm, settings),
        updates=algorithm.updates_per_episode,
        imagined_share=algorithm.training.plan.rows("population").imagined / settings.batch_size,
        best=None if trial is None else trial.best,
        quiet=settings.quiet,
    )
    kind = settings.log if settings.log != "off" else FORMERLY[settings.wandb]
    log = None if kind == "off" else RunLog(folder, name, kind, names, quiet=settings.quiet)
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


def forecast_of(algorithm: Followed, settings: Settings) -> Forecast:
    """How long the run will take from where it stands; beside preset paper also how long a first look takes."""
    body, chosen = type(algorithm.env), algorithm.position.index + (algorithm.position.trial is not None)
    left = work_of(body, settings, episodes=algorithm.position.env_steps // settings.episode_steps, designs=chosen)
    quick = work_of(body, QUICK)
    shorter = settings.preset != "quick" and quick.episodes < left.episodes
    return Forecast(left, goes_on=settings.resume is not None, quick=quick if shorter else None)
