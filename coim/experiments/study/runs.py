"""The runs of a study: which there are to be, how far each is, and what a diverged one counts.

Shapes: M designs.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from coim.experiments.frames import read_frame
from coim.experiments.run.records import Record, number, read_record
from coim.experiments.study.arms import in_order
from coim.experiments.study.definition import from_json
from coim.experiments.study.ledger import read_ledger
from coim.run_folder import DESIGNS, EVALUATIONS
from coim.tables import Layout

Place = tuple[str, str]  # environment and task

CHOSEN = Layout(  # what ``coim retrain`` has chosen to train from scratch, in ``retrained/``
    file="designs.csv",
    columns={
        "folder": str,
        "cell": str,
        "environment": str,
        "task": str,
        "arm": str,
        "seed": int,
        "run": int,
        "design": int,
        "xi": str,
        "found_return": float,
        "over": float,  # runs of the arm that were over, and how many there were to be
        "planned": float,
        "found": float,  # candidates in all runs of the arm, and how many of them were kept
        "kept": float,
        "top": float,
        "most": float,
        "of": str,
        "trained": str,  # FOLDER/RUN that trains it, if in lock-step with others; else by itself, in its own folder
    },
    needed=("folder", "cell", "environment", "task", "arm", "seed", "run", "design", "xi", "found_return"),
    grows=False,
)


def trained_in(line: Mapping[str, Any]) -> tuple[str, int]:
    """The folder that trains a design, given its line of `CHOSEN`, and the number of its run there."""
    folder, _, run = str(line["trained"]).rpartition("/")
    return (folder, int(run)) if folder else (line["folder"], 0)


@dataclass(frozen=True)
class Run:
    """One run of one cell; a cell that advances several in lock-step has as many.

    Attributes:
        environment: name of the body.
        task: forward or backward.
        arm: what is compared.
        seed: of the cell.
        number: of the run within the cell, from 0.
        record: the cell's folder, read back.
        diverged: whether it broke down before it had tried all designs.
        given_up: whether its cell failed again and again.
    """

    environment: str
    task: str
    arm: str
    seed: int
    number: int
    record: Record
    diverged: bool
    given_up: bool = False

    @property
    def num_designs(self) -> int:
        """M, the designs it is to try."""
        return self.record.settings["num_designs"]

    @cached_property
    def designs(self) -> pd.DataFrame:
        """Designs that have a best return: all episodes done, or as far as a diverged run came; see `Record`."""
        rows = self.record.designs
        there = (rows["run"] == self.number) & np.isfinite(rows["best_return"]) & (rows["finished"] | self.diverged)
        return rows[there].sort_values("design")

    @property
    def over(self) -> bool:
        """Whether nothing more will come."""
        return self.diverged or len(self.designs) == self.num_designs

    @property
    def state(self) -> str:
        """In a word."""
        if self.over:
            return "diverged" if self.diverged else "finished"
        return "failed" if self.given_up else "under way"

    def best_returns(self, failure: float) -> np.ndarray:
        """Best return of each design, ``[M]``; NaN where it is still to come.

        A diverged run counts with ``failure`` on each design that it did not reach: left out, it would leave its arm
        with the mean of those that held.
        """
        values = np.full(self.num_designs, failure if self.diverged else math.nan)
        values[self.designs["design"] - 1] = self.designs["best_return"]
        return values


@dataclass(frozen=True)
class Runs:
    """All runs of a study.

    Attributes:
        found: those that have begun.
        planned: number of runs to come or there, by (environment, task, arm).
        given_up: those of cells that failed again and again.
    """

    found: list[Run]
    planned: Counter[tuple[str, str, str]]
    given_up: Counter[tuple[str, str, str]]

    @property
    def places(self) -> list[Place]:
        """Environments and tasks, as the ledger has them."""
        return list(dict.fromkeys((environment, task) for environment, task, _ in self.planned))

    @property
    def arms(self) -> list[str]:
        """All that are planned."""
        return in_order(arm for _, _, arm in self.planned)

    def arms_at(self, place: Place) -> list[str]:
        """All that are planned in one environment and task."""
        return [arm for arm in self.arms if self.planned[*place, arm]]

    def of(self, place: Place, arm: str) -> list[Run]:
        """Those of one environment, task and arm, by seed."""
        runs = [run for run in self.found if (run.environment, run.task, run.arm) == (*place, arm)]
        return sorted(runs, key=lambda run: (run.seed, run.number))

    def kinds(self, place: Place, arm: str) -> dict[int, str]:
        """Kind of each design of an arm, by its number, as far as any of its runs has come: they take turns alike."""
        tables = [run.designs for run in self.of(place, arm)]
        return {design: kind for table in tables for design, kind in zip(table["design"], table["kind"])}

    def failure(self, place: Place) -> float:
        """What a design that a diverged run did not reach counts: the lowest best return of any design there.

        So that no run is behind it, whatever the sign of the rewards; NaN where no design has a return yet.
        """
        own = [run for run in self.found if (run.environment, run.task) == place]
        return min((run.designs["best_return"].min() for run in own if len(run.designs)), default=math.nan)

    def in_words(self, arms: list[str], *, counted: bool = False) -> str:
        """How many of how many runs are over, and what is to be known of those that are not, or diverged.

        Args:
            arms: of the runs.
            counted: whether something is shown in which diverged runs count on designs that they did not reach.
        """
        own = [run for run in self.found if run.arm in arms]
        states = Counter(run.state for run in own)
        over, diverged, under_way = states["finished"] + states["diverged"], states["diverged"], states["under way"]
        planned, given_up = (
            sum(count for (_, _, arm), count in counts.items() if arm in arms)
            for counts in (self.planned, self.given_up)
        )
        if over == planned:
            words = f"All {planned} runs are over"
        else:
            words = f"{over} of {planned} runs are over, {under_way} under way, "
            words += f"{planned - over - under_way - given_up} to come"
            words += f", {given_up} failed (ledger.csv says why)" * bool(given_up)
        lengths = sorted({run.num_designs for run in own})
        longer = f" They are to try different numbers of designs: {', '.join(map(str, lengths))}." * (len(lengths) > 1)
        how = self._diverged_in_words(own, under_way, counted) if diverged else "none diverged"
        return f"{words}; {how}.{longer}"

    def _diverged_in_words(self, own: list[Run], under_way: int, counted: bool) -> str:
        """What diverging means, and what it does to the numbers."""
        broken = [run for run in own if run.diverged]
        places = dict.fromkeys((run.environment, run.task) for run in broken)
        values = "; ".join(f"{', '.join(place)}: {number(self.failure(place))}" for place in places)
        words = f"{len(broken)} of them diverged (a loss, weight or moment became no finite number, or a weight huge)"
        if not counted:
            return f"{words}; what is shown of them is of the designs that they reached"
        words += (
            " and count, on each design that they did not reach, with the lowest best return that any run of the "
            f"environment and task has on a design ({values}), on which the means and Welch's test depend"
        )
        if under_way:
            words += "; they are over before the others, so until all are over their arm looks worse than it is"
        return words


def read_runs(study: Path) -> Runs:
    """Read a study's folder, in any state of it.

    Raises:
        ValueError: if it is none, or its ``study.json`` or a cell's folder cannot be read.
    """
    cells = study / "cells"
    if not cells.is_dir():
        raise ValueError(
            f"{study} is no study's folder: it has no cells/; name a folder that coim.experiments.commands.study wrote"
        )
    ledger = {entry.cell: entry.state for entry in read_ledger(study / "ledger.csv")}
    names = [*ledger, *sorted(path.name for path in cells.iterdir() if path.is_dir())]
    found: list[Run] = []
    planned: Counter[tuple[str, str, str]] = Counter()
    given_up: Counter[tuple[str, str, str]] = Counter()
    sizes = sizes_of_cells(study / "study.json")
    for name in dict.fromkeys(names):
        failed = ledger.get(name) == "failed"
        own = [replace(run, given_up=failed) for run in runs_of_cell(cells / name)]
        found += own
        which = parts_of(name)[:3]
        size = own[0].record.settings["num_runs"] if own else sizes.get(name, 1)
        planned[which] += size
        given_up[which] += size * failed
    return Runs(found, planned, given_up)


def sizes_of_cells(path: Path) -> dict[str, int]:
    """Runs of each cell that a study has by its ``study.json``; empty where there is none."""
    return {cell.name: cell.settings.num_runs for cell in from_json(path).cells()} if path.is_file() else {}


def runs_of_cell(folder: Path) -> list[Run]:
    """Those of one cell that have begun."""
    environment, task, arm, seed = parts_of(folder.name)
    return runs_of_folder(folder, environment, task, arm, seed)


def runs_of_folder(folder: Path, environment: str, task: str, arm: str, seed: int) -> list[Run]:
    """Those in an ordinary run folder that have begun."""
    if read_frame(folder / EVALUATIONS.file, EVALUATIONS).empty:
        return []
    record = read_record(folder, folder.name)
    said = pd.concat([record.episodes, read_frame(folder / DESIGNS.file, DESIGNS)])
    diverged = {*said["run"][said["diverged"] != ""]}
    numbers = sorted({*record.episodes["run"]})
    return [Run(environment, task, arm, seed, number, record, number in diverged) for number in numbers]


def parts_of(cell: str) -> tuple[str, str, str, int]:
    """Environment, task, arm and seed of a cell's name; only an arm has hyphens of its own.

    Raises:
        ValueError: if the name has another form.
    """
    environment, _, rest = cell.partition("-")
    task, _, rest = rest.partition("-")
    arm, _, seed = rest.rpartition("-")
    if not (environment and task and arm and seed.isdecimal()):
        raise ValueError(f"cell {cell!r} is not named ENVIRONMENT-TASK-ARM-SEED, as hopper-forward-none-0")
    return environment, task, arm, int(seed)
