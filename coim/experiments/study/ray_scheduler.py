"""Ray computes the cells of a study, on this machine or on a cluster.

Ray decides where and when, and tries again what failed; here is only what it is asked for and what its user hears.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

import ray
from ray.exceptions import RayError, RayTaskError

from coim.envs import BODIES
from coim.experiments.run.build import episodes_of_designs
from coim.experiments.run.duration import in_words
from coim.experiments.run.interrupt import sentence_of
from coim.experiments.run.resume import resumed, still_finished
from coim.experiments.run.settings import Settings
from coim.experiments.study.cell import compute, episodes_done, seconds_of, tries
from coim.experiments.study.definition import Cell
from coim.experiments.study.ledger import Ledger

RETRIES = 2  # of a cell that fails, and of one whose process dies
CELLS = "cells"  # of a study's folder
POLL = 0.5  # s between two looks at who has begun


@dataclasses.dataclass(frozen=True)
class Resources:
    """Resources of each cell.

    Attributes:
        cpus: cores, and threads that may be busy at once.
        gpus: share of a GPU; above 0 the networks live there.
    """

    cpus: int = 1
    gpus: float = 0.0


class Conductor:
    """Has the cells of a study computed, and keeps its ledger.

    Args:
        folder: of the study; every node must see it under this name.
        cells: of the study.
        ledger: of the study.
        resources: of each cell.
        terminal: where its user reads.
    """

    def __init__(
        self, folder: Path, cells: Sequence[Cell], ledger: Ledger, resources: Resources, terminal: TextIO
    ) -> None:
        self.ledger, self.folder = ledger, folder.resolve()
        unfinished = set(ledger.in_state("waiting"))
        self.cells = [cell for cell in cells if cell.name in unfinished]
        self.resources, self._terminal = resources, terminal
        self._made_before = sum(self._episodes_done(cell) for cell in self.cells)
        self._started = time.monotonic()

    def conduct(self) -> list[str]:
        """Let all cells be computed that are not finished.

        Returns:
            Names of those that failed again and again.

        Raises:
            KeyboardInterrupt: when told to end (see `coim.experiments.run.interrupt.stopping_at_once`). All processes
                that compute end at once: checkpoints are made for that.
        """
        running = self._submit()
        if running:
            words = f"{len(running)} cell(s) wait for their processes, which take 10 to 30 s to load PyTorch"
            print(words, file=self._terminal, flush=True)
        self._wait_for(running)
        return self.ledger.in_state("failed")

    def _submit(self) -> dict[ray.ObjectRef, Cell]:
        """Hand all cells to Ray, which begins with the first as soon as there are resources."""
        remote = ray.remote(
            num_cpus=self.resources.cpus,
            num_gpus=self.resources.gpus,
            max_retries=RETRIES,
            retry_exceptions=True,
        )(compute)
        return {
            remote.remote(cell.environment, settings_in(self.folder, cell, self.resources), self.log_of(cell)): cell
            for cell in self.cells
        }

    def _wait_for(self, running: dict[ray.ObjectRef, Cell]) -> None:
        try:
            while running:
                done, _ = ray.wait(list(running), timeout=POLL)
                self._note_tries()
                for reference in done:
                    self._note_end(running.pop(reference), reference)
        finally:
            for reference in running:  # a cluster outlives this process
                ray.cancel(reference, force=True)
            try:
                self._note_tries()  # of the cells that began since the last look
            finally:
                self.ledger.stop()

    def folder_of(self, cell: Cell) -> Path:
        return self.folder / CELLS / cell.name

    def log_of(self, cell: Cell) -> Path:
        return self.folder / "logs" / f"{cell.name}.log"

    def _note_tries(self) -> None:
        """Say who has begun since the last look."""
        for cell in self.cells:
            entry = self.ledger.entries[cell.name]
            if entry.state in ("waiting", "running") and (count := tries(self.log_of(cell))) > entry.tries:
                again = "goes on" if self.folder_of(cell).exists() and count > 1 else "started"
                self.ledger.note(cell.name, "running", tries=count)
                self._say(cell, f"{again} (try {count})" if count > 1 else again)

    def _note_end(self, cell: Cell, reference: ray.ObjectRef) -> None:
        try:
            ray.get(reference)
        except RayError as error:
            why = sentence_of(error.cause if isinstance(error, RayTaskError) else error)
            message = " ".join(why.split())
            self.ledger.note(cell.name, "failed", message=message)
            self._say(cell, f"failed: {message[:200]}; see {self.log_of(cell)}")
            return
        seconds = round(seconds_of(self.folder_of(cell)), 1)
        self.ledger.note(cell.name, "finished", seconds=seconds, message="")
        finished, total = len(self.ledger.in_state("finished")), len(self.ledger.entries)
        self._say(cell, f"finished in {in_words(seconds)}; {finished} of {total}{self._time_left()}")

    def _time_left(self) -> str:
        """Judged by the episodes that were made since this process began."""
        made = sum(self._episodes_done(cell) for cell in self.cells) - self._made_before
        failed = set(self.ledger.in_state("failed"))
        missing = sum(all_episodes(c) - self._episodes_done(c) for c in self.cells if c.name not in failed)
        if missing <= 0 or made <= 0:
            return ""
        return f", about {in_words((time.monotonic() - self._started) * missing / made)} left"

    def _episodes_done(self, cell: Cell) -> int:
        return episodes_done(self.folder_of(cell), cell.settings.num_runs)

    def _say(self, cell: Cell, words: str) -> None:
        print(f"{time.strftime('%H:%M:%S')}  {cell.name}  {words}", file=self._terminal, flush=True)


def settings_in(folder: Path, cell: Cell, resources: Resources) -> Settings:
    """Settings of a cell's run, with its folder and its share of this machine."""
    device = "cuda" if resources.gpus else cell.settings.device
    return dataclasses.replace(cell.settings, out=folder / CELLS / cell.name, threads=resources.cpus, device=device)


def take_up(folder: Path, cells: Sequence[Cell], resources: Resources) -> Ledger:
    """The ledger of a study, in which what was finished waits again if it is gone or has more designs to try.

    Args:
        folder: of the study; only its ledger is written, and that only if nothing is refused.
        cells: of the study.
        resources: of each cell.

    Raises:
        ValueError: if a cell that has begun or is finished was made with other settings than the study has now, or
            cannot go on.
    """
    ledger = Ledger(folder / "ledger.csv", cells)
    for cell in cells:
        settings, entry = settings_in(folder, cell, resources), ledger.entries[cell.name]
        own = folder / CELLS / cell.name
        if entry.state == "finished" and still_finished(settings, own):
            continue
        resumed(settings, own)
        ledger.entries[cell.name] = dataclasses.replace(entry, state="waiting", seconds=None)
    ledger.write()
    return ledger


def refuse_lack(resources: Resources, terminal: TextIO, *, waits: bool) -> None:
    """Say what no node has, before cells wait for it.

    Args:
        resources: of each cell.
        terminal: where its user reads.
        waits: whether a node that has them may still come.

    Raises:
        ValueError: if none will come: the cells would wait for ever.
    """
    if lack := lacking(resources):
        if not waits:
            raise ValueError(f"{lack} here; ask for less")
        print(f"{lack}; waiting for one", file=terminal, flush=True)


def lacking(resources: Resources) -> str:
    """What no node of the cluster that we are connected to has, or nothing."""
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if any(node.get("CPU", 0) >= resources.cpus and node.get("GPU", 0) >= resources.gpus for node in nodes):
        return ""
    return f"no node has {resources.cpus} cores" + (f" and {resources.gpus:g} of a GPU" if resources.gpus else "")


def all_episodes(cell: Cell) -> int:
    """Training episodes of a whole cell."""
    return sum(episodes_of_designs(BODIES[cell.environment], cell.settings))
