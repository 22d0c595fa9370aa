"""Retrain the best designs that each arm found from scratch, for Fig. 2: ``coim retrain STUDY_FOLDER``.

An arm has found the designs that it chose by Eq. 5 (kind "optimised"). The first designs are given to every arm, and
the random ones are no merit of an arm. From each run, the best half of these designs, by their best return in the
study, is trained with plain SAC: Algorithm 1 with this one design, no population and nothing imagined. The best half
of all runs together would come from few runs, and a test of arms would take the luck of these runs for the arm's merit.
To compare an arm with one that does not search, ``--of all --most 1`` takes the best body of each run instead, whatever
its kind.

``retrained/designs.csv`` in the study's folder names the designs. They are not chosen again when the study grows. The
file also has the number of the arm's runs that were over at that time, and how many of their designs were kept. Beside
it are a ledger and ``cells/`` with an ordinary run folder for each design. The same command goes on: finished designs
are skipped, stopped ones are resumed from their checkpoint.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import tyro

from coim.experiments.command import as_help
from coim.experiments.frames import rows_of
from coim.experiments.run.interrupt import locked, on_command_line, stopping_at_once
from coim.experiments.run.machine import available_cores
from coim.experiments.study.cluster import ray_running, without_words_of_ray
from coim.experiments.study.ray_scheduler import Conductor, Resources, refuse_lack, take_up
from coim.experiments.study.retraining import Retrain, Retraining, cells_of, choose
from coim.experiments.study.runs import CHOSEN, read_runs

DEFAULT = ", as the study gave to a first design (the paper: 300); --episodes takes another number"


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line; ends with 1 if a design could not be trained."""
    asked = tyro.cli(Retrain, prog="coim retrain", description=as_help(__doc__), args=arguments)
    with on_command_line(own_process=arguments is None, again="the same command goes on"):
        failed = retrain(asked)
    if failed:
        sys.exit(f"failed: {', '.join(failed)}; see {asked.study}/retrained/ledger.csv")


def retrain(asked: Retrain) -> list[str]:
    """Choose, write down what was chosen, and train what is not trained yet.

    Returns:
        Names of what failed again and again.

    Raises:
        ValueError: if the share is not in (0, 1], a count is below 1, an arm is none of the study's, no design was
            found yet, what is retrained already was chosen or trained otherwise, or a GPU is asked for and none is
            here.
    """
    check(asked)
    folder = asked.study / "retrained"
    runs = read_runs(asked.study)
    with locked(folder):
        chosen = choose(runs, folder / CHOSEN.file, asked)
        cells = cells_of(rows_of(chosen), asked)
        resources = Resources(gpus=asked.gpus)
        try:
            ledger = take_up(folder, cells, resources)
        except ValueError as error:
            raise ValueError(f"{error}; or move {folder} away to choose and train anew") from None
        waiting = len(ledger.in_state("waiting"))
        of = f" of {len(chosen)} designs" * (len(cells) < len(chosen))
        print(f"{waiting} of {len(cells)} {'fleets' if of else 'designs'}{of} to train -> {folder}")
        if not waiting:
            return []
        print(f"{episodes_in_words(cells)} training episodes on each{'' if asked.episodes else DEFAULT}")
        workers = asked.workers or available_cores()
        with (
            without_words_of_ray(folder) as terminal,
            ray_running(terminal, address=asked.ray_address, workers=workers),
            stopping_at_once(),  # Ray takes SIGTERM for itself when it starts
        ):
            refuse_lack(resources, terminal, waits=asked.ray_address is not None)
            return Conductor(folder, cells, ledger, resources, terminal).conduct()


def check(asked: Retrain) -> None:
    """Refuse what cannot be done."""
    if asked.top is not None and not 0 < asked.top <= 1:
        raise ValueError(f"--top is {asked.top}, a share of the designs lies in (0, 1]; Fig. 2 has 0.5")
    for name, least in (("most", 1), ("episodes", 1), ("together", 1), ("workers", 0), ("gpus", 0)):
        if (value := getattr(asked, name)) is not None and value < least:
            raise ValueError(f"--{name} is {value}, it must be at least {least}")
    if asked.workers and asked.ray_address is not None:
        raise ValueError("--workers is of this machine; a cluster decides itself, by --gpus of each design")


def episodes_in_words(cells: Sequence[Retraining]) -> str:
    """Training episodes of the designs, which differ where the environments of a study do."""
    return " or ".join(str(count) for count in sorted({cell.settings.first_episodes for cell in cells}))
