"""Weights & Biases beside a run: it may fail or hang, the run goes on."""

from __future__ import annotations

import os
import queue
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

from torchrl.record.loggers.wandb import WandbLogger

from coim.events import EpisodeDone, Event, running
from coim.run_folder import read_config
from coim.tables import design_columns

PATIENCE = 60  # s that the end of a run waits for what W&B still has to write or send


class WandbLog:
    """Sends the numbers of the CSV files to W&B from a thread of its own; nothing is only there.

    Online without an account or a network, W&B asks on the terminal or waits for minutes and fails. Here it is never
    asked: it goes offline with a warning, below the run's folder, for ``wandb sync`` to send later.

    A run that is resumed goes on in the W&B run that it had: the id is in ``config.json``.

    Args:
        folder: of the run.
        environment: name of the body, for the project.
        mode: online needs an account and a network, offline neither.
        design_names: of the entries of a design.
        quiet: whether W&B says nothing of its own on the terminal.
    """

    def __init__(
        self,
        folder: Path,
        environment: str,
        mode: Literal["offline", "online"],
        design_names: Sequence[str],
        *,
        quiet: bool = False,
    ) -> None:
        self._folder, self._environment, self._quiet = folder, environment, quiet
        self._design_columns = design_columns(design_names)
        try:
            logger = self._open(offline=mode == "offline")
        except Exception as error:  # W&B's own kinds have no common name
            if mode == "offline":
                raise OSError(f"W&B cannot be started ({_first_line(error)}); leave it --wandb off") from error
            warn(f"W&B cannot be reached ({_first_line(error)}); it goes on offline, `wandb sync` sends it later")
            logger = self._open(offline=True)
        self._waiting: queue.SimpleQueue[EpisodeDone | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, args=(logger,), name="wandb-log", daemon=True)
        self._thread.start()

    def write(self, event: Event) -> None:
        """Hand over an event; returns at once."""
        if isinstance(event, EpisodeDone):
            self._waiting.put(event)

    def close(self) -> None:
        """Wait until all is written, but not for ever."""
        self._waiting.put(None)
        self._thread.join(PATIENCE)
        if self._thread.is_alive():
            warn(f"W&B has not finished within {PATIENCE} s; the numbers are in the CSV files")

    def _open(self, *, offline: bool) -> WandbLogger:
        config = read_config(self._folder)
        with nobody_to_ask():
            return WandbLogger(
                exp_name=self._folder.name,
                save_dir=str(self._folder),
                offline=offline,
                mode="offline" if offline else "online",  # W&B reads the environment but once in a process
                id=config.get("wandb_id"),  # and resume="allow", which is TorchRL's default
                project=f"coim-{self._environment}",
                config=config,
                settings={"silent": self._quiet},
            )

    def _work(self, logger: WandbLogger) -> None:
        try:
            while (event := self._waiting.get()) is not None:
                for name, value in scalars(event, self._design_columns).items():
                    logger.log_scalar(name, value, step=event.env_steps)
                for run, (index, episode) in event.diverged.items():
                    logger.experiment.summary[f"run {run}/diverged"] = f"design {index + 1}, episode {episode + 1}"
            logger.experiment.finish()
        except Exception as error:  # whatever it is, it is not the run's
            warn(f"W&B has failed ({_first_line(error)}); the run goes on without it, the numbers are in the CSV files")
            with suppress(Exception):
                import wandb  # here alone: it takes as long as all the rest of a recipe to import

                wandb.teardown()  # or it would tell of its death once more, when the process ends


def scalars(event: EpisodeDone, design_columns: Sequence[str]) -> dict[str, float]:
    """The numbers of the CSV files under the names of their columns, one series for each run, over training steps."""
    found = {f"seconds/{part}": value for part, value in event.seconds.items()}
    for run in running(event):
        found[f"run {run}/return"] = float(event.evaluation_return[run])
        found[f"run {run}/training return"] = float(event.training_return[run])
        found |= {f"run {run}/{key}": float(values[run]) for key, values in event.metrics.items()}
        found |= {f"run {run}/{name}": float(xi) for name, xi in zip(design_columns, event.design[run])}
    return found


@contextmanager
def nobody_to_ask() -> Iterator[None]:
    """Empty standard input: who asks on a terminal gets no answer instead of waiting for one."""
    before = sys.stdin
    with Path(os.devnull).open() as sys.stdin:
        try:
            yield
        finally:
            sys.stdin = before


def warn(sentence: str) -> None:
    """Write a line to standard error."""
    print(f"\nwarning: {sentence}", file=sys.stderr)


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)
