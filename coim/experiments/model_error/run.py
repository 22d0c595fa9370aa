"""Train an algorithm while the errors of its model are measured."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path

import torch

from coim.envs import MorphEnv
from coim.experiments.model_error.algorithm import ProbedCoAdaptation, other_learner
from coim.experiments.model_error.design_space import SIDE, design_space, principal_directions, with_area
from coim.experiments.model_error.errors import change_variance
from coim.experiments.model_error.tables import CHANGES, FOLDER
from coim.experiments.model_error.test_rows import Probes, joined
from coim.experiments.run.atomic_write import as_csv, write_whole
from coim.experiments.run.build import build
from coim.experiments.run.machine import checked_device
from coim.experiments.run.settings import Settings
from coim.experiments.train import train
from coim.models import select_run

STATES = 3  # drawn in Fig. 4(b), chosen at random


def run(body: type[MorphEnv], name: str, settings: Settings, *, every: int, rows: int) -> Path:
    """Train and measure; leave an ordinary run's folder with two CSV files more.

    Args:
        body: class of the environment.
        name: the environment's name.
        settings: the run's settings; ``resume`` names the folder of a run to go on with.
        every: episodes of a design between two measurements.
        rows: transitions in each measurement.

    Returns:
        The folder.

    Raises:
        ValueError: if the settings learn no model.
        SystemExit: on Ctrl-C or SIGTERM.
    """

    def make(folder: Path, threads: int, side_by_side: bool) -> ProbedCoAdaptation:
        return probe(body, settings, folder, every=every, rows=rows, threads=threads, side_by_side=side_by_side)

    def finish(probed: ProbedCoAdaptation, folder: Path) -> None:
        note = write_design_space(probed, body, folder)
        if not settings.quiet:
            print(f"{note}\nto draw it: {to_draw(folder)}")

    return train(body, name, settings, make, again="the same line with --out", finish=finish)


def to_draw(folder: Path) -> str:
    """Name the command that draws a measured run; figures look for it in a folder of its study.

    Example:
        >>> to_draw(Path("runs/study-preview/model_error"))
        'coim figures runs/study-preview'
        >>> to_draw(Path("runs/hopper-20260101-120000-model_error"))
        'move it into STUDY_FOLDER/model_error, then coim figures STUDY_FOLDER'
    """
    above = [path.parent for path in (folder, *folder.parents) if path.name == FOLDER]
    command = "coim figures"
    return f"{command} {above[0]}" if above else f"move it into STUDY_FOLDER/{FOLDER}, then {command} STUDY_FOLDER"


def probe(
    body: type[MorphEnv],
    settings: Settings,
    folder: Path,
    *,
    every: int,
    rows: int,
    threads: int = 1,
    side_by_side: bool = False,
) -> ProbedCoAdaptation:
    """Build the run as `coim run` does, with a second model and the rows to measure both on."""
    algorithm = build(body, settings, threads=threads, side_by_side=side_by_side)
    learner = other_learner(
        algorithm,
        lr=settings.model_lr,
        weight_decay=settings.weight_decay,
        precision=settings.precision,
        compile=settings.compile,
    )
    probes = Probes(
        body,
        num_runs=settings.num_runs,
        episode_steps=settings.episode_steps,
        num_rows=rows,
        num_threads=threads,
        device=checked_device(settings.device),
    )
    return ProbedCoAdaptation(algorithm, learner, probes, folder, every=every, sigma=settings.sigma, seed=settings.seed)


def write_design_space(probed: ProbedCoAdaptation, body: type[MorphEnv], folder: Path) -> str:
    """Fig. 4(b)'s numbers from the models as they are at the end; returns what happened in words.

    The first run that has not diverged is drawn, at random states among those through whose design enough of the plane
    can be built. Everything is computed on the CPU, where the simulator is, with copies of the models.
    """
    if not probed.seen:
        return f"no {CHANGES.file}: the run ended before its first measurement"
    learning = [run for run in range(probed.env.numel()) if run not in probed.divergence.places]
    if not learning:
        return f"no {CHANGES.file}: the run diverged, and its model stands still since"
    run = learning[0]
    seen = joined(probed.seen)[:, run].cpu()
    tried = torch.stack([rows["design"][0, run] for rows in probed.seen]).cpu()
    order = torch.randperm(len(seen), generator=torch.Generator().manual_seed(probed.seed))
    models, variance = {}, change_variance(probed.learners["delta"]).cpu()  # the run axis is dropped from both
    for predict, learner in sorted(probed.learners.items()):
        own = learner.ensemble if learner.num_runs is None else select_run(learner.ensemble, run)
        models[predict] = deepcopy(own).cpu()
    variance = variance if variance.ndim == 1 else variance[run]
    simulator, (low, high) = probed.probes.simulator, body.design_bounds()
    bounds = low.float(), high.float()
    try:
        shown = with_area(seen["design"][order], principal_directions(tried)[0], bounds)
        chosen = order[shown][:STATES]
        if not len(chosen):
            return (
                f"no {CHANGES.file}: the plane of the two components leaves the bounds right beside every design tried"
            )
        rows = design_space(models, simulator, seen[chosen], tried, variance, bounds, side=SIDE)
    except ValueError as error:
        return f"no {CHANGES.file}: {error}"
    cells = ({key: f"{x:.7g}" if isinstance(x, float) else x for key, x in row.items()} for row in rows)
    write_whole(folder / CHANGES.file, as_csv(list(rows[0]), cells))
    return f"model errors: {probed.path}\ndesign space: {folder / CHANGES.file}"
