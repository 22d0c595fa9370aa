"""Compute many runs that are compared: ``coim study preview``.

A study has a name, or is a JSON file with these fields: name, environments, arms, seeds, tasks, protocol, overrides,
seeds_per_cell, blocks. Its folder has ``study.json``, ``ledger.csv`` with a row for each cell, ``cells/`` with an
ordinary run folder for each, and ``logs/``. The same command goes on with the cells that are not finished.
`Ray <https://docs.ray.io>`_ computes the cells, on this machine or, with ``--ray-address``, on a cluster whose nodes
see the folder under the same name and have the same version of coim.
"""

from __future__ import annotations

import dataclasses
import math
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from coim.experiments.command import as_help
from coim.experiments.run.atomic_write import write_whole
from coim.experiments.run.interrupt import locked, on_command_line, stopping_at_once
from coim.experiments.run.machine import available_cores, checked_device
from coim.experiments.study.cluster import ray_running, without_words_of_ray
from coim.experiments.study.definition import Cell, Study, from_json, to_json
from coim.experiments.study.ledger import Ledger
from coim.experiments.study.named import STUDIES
from coim.experiments.study.ray_scheduler import RETRIES, Conductor, Resources, refuse_lack, take_up


@dataclasses.dataclass(frozen=True)
class Options:
    """Make the runs of a study, or go on with them."""

    study: Annotated[tyro.conf.Positional[str], tyro.conf.arg(help=f"{', '.join(STUDIES)}, or a JSON file.")]
    out: Path | None = None
    """Folder of the study; by default runs/study-NAME."""
    workers: int = 0
    """Cells at once on this machine; 0 takes as many as have cores."""
    ray_address: str | None = None
    """A Ray cluster, such as 10.0.0.1:6379; it decides how many cells go at once. By default this machine. auto takes
    one that runs here, which may be that of another study and end with it."""
    cpus: int = 1
    """Cores of a cell, and threads that may be busy at once in it."""
    gpus: float = 0.0
    """Share of a GPU for each cell; above 0 its networks live there."""


def conduct(options: Options) -> None:
    """Conduct a study; ends with 1 if a cell failed again and again."""
    check(options)
    study = find(options.study)
    folder = options.out or Path("runs") / f"study-{study.name}"
    resources = Resources(options.cpus, options.gpus)
    workers = options.workers or max(1, available_cores() // options.cpus)
    with locked(folder):
        cells = study.cells()
        ledger = taken_up(folder, cells, resources)
        write_whole(folder / "study.json", to_json(study))
        waiting = len(ledger.in_state("waiting"))
        print(f"{study.name}: {waiting} of {len(cells)} cells to compute -> {folder}")
        if not waiting:
            return
        with (
            without_words_of_ray(folder) as terminal,
            ray_running(terminal, address=options.ray_address, workers=workers, cpus=options.cpus),
            stopping_at_once(),  # once more: Ray takes SIGTERM for itself when it starts
        ):
            refuse_lack(resources, terminal, waits=options.ray_address is not None)
            failed = Conductor(folder, cells, ledger, resources, terminal).conduct()
    if failed:
        told = [f"  {name}: {ledger.entries[name].message[:300]}" for name in failed]
        again = f"to try them again: {command(options)}"
        sys.exit("\n".join([f"failed, after {1 + RETRIES} tries each:", *told, again]))


def taken_up(folder: Path, cells: list[Cell], resources: Resources) -> Ledger:
    """The ledger of a study; what is refused is told with the options that are meant."""
    try:
        return take_up(folder, cells, resources)
    except ValueError as error:
        raise ValueError(f"{error} (the folder is --out, the device that of --gpus)") from None


def check(options: Options) -> None:
    """Refuse by name what cannot be asked for."""
    if options.cpus < 1:
        raise ValueError(f"--cpus is {options.cpus}, a cell needs at least 1")
    if not 0 <= options.gpus < math.inf:
        raise ValueError(f"--gpus is {options.gpus}, a share is at least 0")
    if options.workers < 0:
        raise ValueError(f"--workers is {options.workers}, it must be at least 0 (0: as many as have cores)")
    if options.workers and options.ray_address is not None:
        raise ValueError("--workers is of this machine; a cluster decides itself, by --cpus and --gpus of each cell")
    if options.ray_address is None:
        check_machine(options)


def check_machine(options: Options) -> None:
    """Refuse what this machine has not."""
    cores, asked = available_cores(), max(1, options.workers) * options.cpus
    if asked > cores:
        raise ValueError(
            f"--workers x --cpus is {max(1, options.workers)} x {options.cpus}, this machine has {cores} core(s) for "
            "us; ask for less, or leave both away"
        )
    if options.gpus > 0:
        checked_device("cuda")


def find(study: str) -> Study:
    """A study by its name or its file.

    Raises:
        ValueError: if there is neither.
    """
    if study in STUDIES:
        return STUDIES[study]
    if study.endswith(".json"):
        return from_json(Path(study))
    raise ValueError(f"{study!r} is no study: there are {', '.join(STUDIES)}, or name a file that ends in .json")


def command(options: Options) -> str:
    """The line that goes on with a study."""
    given = [
        word
        for field in dataclasses.fields(Options)[1:]
        if (value := getattr(options, field.name)) != field.default
        for word in (f"--{field.name.replace('_', '-')}", str(value))
    ]
    return shlex.join(["coim", "study", options.study, *given])


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    options = tyro.cli(Options, prog="coim study", description=as_help(__doc__), args=arguments)
    with on_command_line(own_process=arguments is None, again=f"to go on: {command(options)}"):
        conduct(options)
