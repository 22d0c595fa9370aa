"""Fig. 4(a) and (b): how well the learnt dynamics know bodies, over the training of one run.

``python -m recipes.model_error ENVIRONMENT --out STUDY_FOLDER/model_error`` follows Algorithm 1 as the environment's
own recipe does and measures on the way; the same line again goes on with a run that was stopped.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from copy import deepcopy
from pathlib import Path

import torch

from coim import MorphEnv, select_run
from coim.envs import BODIES
from recipes.experiment import train
from recipes.interrupt import on_command_line
from recipes.machine import checked_device
from recipes.parts import build
from recipes.plots.measured import FOLDER
from recipes.probing.design_space import FILE, SIDE, design_space, principal_directions, with_area
from recipes.probing.errors import change_variance
from recipes.probing.probed import ProbedCoAdaptation, other_learner
from recipes.probing.probes import Probes, joined
from recipes.settings import Settings, parse
from recipes.writing import as_csv, write_whole

STATES = 3  # of which Fig. 4(b) is drawn, at random


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line: the environment, two options of its own, and every setting of the environment's recipe."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    own = argparse.ArgumentParser(
        prog="python -m recipes.model_error", description=__doc__, add_help=False, allow_abbrev=False
    )
    own.add_argument("environment", choices=BODIES)
    own.add_argument("--every", type=int, default=10, help="episodes of a design between two measurements (10)")
    own.add_argument("--rows", type=int, default=200, help="transitions in each measurement (200)")
    own.add_argument("--out", type=Path, help="folder; one that holds such a run is gone on with")
    if {"-h", "--help"} & {*given}:
        print(own.format_help())
        given = [name for name in given if name in BODIES][:1] or ["hopper"]
        given.append("--help")  # the recipe's settings follow
    asked, rest = own.parse_known_args(given)
    with on_command_line(own_process=arguments is None):
        for name in ("every", "rows"):
            if getattr(asked, name) < 1:
                raise ValueError(f"--{name} is {getattr(asked, name)}, it must be at least 1")
        words = [*folder_options(asked.out), *rest]
        # States are swapped by noisy designs too, whatever the run imagines.
        settings = parse(f"{own.prog} {asked.environment}", str(__doc__), words, read=("sigma",))
        run(BODIES[asked.environment], asked.environment, settings, every=asked.every, rows=asked.rows)


def folder_options(out: Path | None) -> list[str]:
    """The recipe's own words for a folder: gone on with where there is a run, or made."""
    if out is None:
        return ["--name", "model_error"]
    return ["--resume" if (out / "config.json").exists() else "--out", str(out)]


def run(body: type[MorphEnv], name: str, settings: Settings, *, every: int, rows: int) -> Path:
    """Train and measure; leave an ordinary run's folder with two CSV files more.

    Args:
        body: the environment.
        name: of the environment.
        settings: of the run; ``resume`` names the folder of one to go on with.
        every: episodes of a design between two measurements.
        rows: transitions in each of them.

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
    """What draws a measured run; figures look for it below a folder of its study.

    Example:
        >>> to_draw(Path("runs/study-preview/model_error"))
        'python -m recipes.figures runs/study-preview'
        >>> to_draw(Path("runs/hopper-20260101-120000-model_error"))
        'move it into STUDY_FOLDER/model_error, then python -m recipes.figures STUDY_FOLDER'
    """
    above = [path.parent for path in (folder, *folder.parents) if path.name == FOLDER]
    command = "python -m recipes.figures"
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
    """Build the run as its recipe does, and put a second model and the probes beside it."""
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

    They are of the first run that has not diverged, and of random states among those through whose design enough of the
    plane can be built. All is computed on the CPU, where the simulator is, with copies of the models.
    """
    if not probed.seen:
        return f"no {FILE}: the run ended before its first measurement"
    learning = [run for run in range(probed.env.numel()) if run not in probed.divergence.places]
    if not learning:
        return f"no {FILE}: the run diverged, and its model stands still since"
    run = learning[0]
    seen = joined(probed.seen)[:, run].cpu()
    tried = torch.stack([rows["design"][0, run] for rows in probed.seen]).cpu()
    order = torch.randperm(len(seen), generator=torch.Generator().manual_seed(probed.seed))
    models, variance = {}, change_variance(probed.learners["delta"]).cpu()  # the run axis is dropped from both
    for predict, learner in sorted(probed.learners.items()):
        own = learner.ensemble if learner.num_runs is None else select_run(learner.ensemble, run)
        models[predict] = deepcopy(own).cpu()
    variance = variance if variance.ndim == 1 else variance[run]
    simulator, bounds = probed.probes.simulator, body.DESIGN_BOUNDS
    try:
        shown = with_area(seen["design"][order], principal_directions(tried)[0], bounds)
        chosen = order[shown][:STATES]
        if not len(chosen):
            return f"no {FILE}: the plane of the two components leaves the bounds right beside every design tried"
        rows = design_space(models, simulator, seen[chosen], tried, variance, bounds, side=SIDE)
    except ValueError as error:
        return f"no {FILE}: {error}"
    shown = ({key: f"{x:.7g}" if isinstance(x, float) else x for key, x in row.items()} for row in rows)
    write_whole(folder / FILE, as_csv(list(rows[0]), shown))
    return f"model errors: {probed.path}\ndesign space: {folder / FILE}"


if __name__ == "__main__":
    main()
