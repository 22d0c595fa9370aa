"""TensorBoard, trackio or Weights & Biases beside a run: it may fail or hang, the run goes on."""

from __future__ import annotations

import os
import queue
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

from torchrl.record.loggers.common import Logger

from coim.events import EpisodeDone, Event, running
from coim.run_folder import read_config
from coim.tables import design_columns

Kind = Literal["tensorboard", "trackio", "wandb", "wandb-offline"]
NAMES: dict[Kind, str] = {"tensorboard": "TensorBoard", "trackio": "trackio", "wandb": "W&B", "wandb-offline": "W&B"}
# From the former setting --wandb.
FORMERLY: dict[str, Kind | Literal["off"]] = {"off": "off", "offline": "wandb-offline", "online": "wandb"}
PATIENCE = 60  # s that the end of a run waits for what a logger still has to write or send


class RunLog:
    """Sends the numbers of the CSV files to one of TorchRL's loggers from a thread of its own; nothing is only there.

    TensorBoard's files are in ``tensorboard/`` of the run's folder; trackio's are where it keeps all of its projects,
    on this machine.

    Online without an account or a network, W&B asks on the terminal or waits for minutes and fails. Here it is never
    asked: it goes offline with a warning, below the run's folder, for ``wandb sync`` to send later.

    A run that is resumed goes on in the W&B run that it had: the id is in ``config.json``.

    Args:
        folder: of the run.
        environment: name of the body, for the project.
        kind: which logger. W&B needs an account and a network, all others neither.
        design_names: of the entries of a design.
        quiet: whether W&B says nothing of its own on the terminal.

    Raises:
        OSError: if the logger is not installed or cannot be started.
    """

    def __init__(
        self,
        folder: Path,
        environment: str,
        kind: Kind,
        design_names: Sequence[str],
        *,
        quiet: bool = False,
    ) -> None:
        self._folder, self._environment, self._quiet, self._name = folder, environment, quiet, NAMES[kind]
        self._design_columns = design_columns(design_names)
        try:
            logger = self._open(kind)
        except Exception as error:  # W&B's own kinds have no common name
            if kind != "wandb":
                package = kind.removesuffix("-offline")
                raise OSError(
                    f"{self._name} cannot be started ({_first_line(error)}); pip install {package} where it is "
                    "missing, or leave it --log off"
                ) from error
            warn(f"W&B cannot be reached ({_first_line(error)}); it goes on offline, `wandb sync` sends it later")
            logger = self._open("wandb-offline")
        self._waiting: queue.SimpleQueue[EpisodeDone | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, args=(logger,), name="run-log", daemon=True)
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
            warn(f"{self._name} has not finished within {PATIENCE} s; the numbers are in the CSV files")

    def _open(self, kind: Kind) -> Logger:
        config, project, offline = read_config(self._folder), f"coim-{self._environment}", kind == "wandb-offline"
        if kind == "tensorboard":
            from torchrl.record.loggers.tensorboard import TensorboardLogger

            return TensorboardLogger(exp_name="", log_dir=str(self._folder / kind))
        if kind == "trackio":
            from torchrl.record.loggers.trackio import TrackioLogger

            return TrackioLogger(exp_name=self._folder.name, project=project, config=config)
        from torchrl.record.loggers.wandb import WandbLogger

        with nobody_to_ask():
            return WandbLogger(
                exp_name=self._folder.name,
                save_dir=str(self._folder),
                offline=offline,
                mode="offline" if offline else "online",  # W&B reads the environment but once in a process
                id=config.get("wandb_id"),  # and resume="allow", which is TorchRL's default
                project=project,
                config=config,
                settings={"silent": self._quiet},
            )

    def _work(self, logger: Logger) -> None:
        try:
            while (event := self._waiting.get()) is not None:
                for name, value in scalars(event, self._design_columns).items():
                    logger.log_scalar(name, value, step=event.env_steps)
                for run in event.diverged:
                    self._tell_divergence(logger, run, event)
            # TensorBoard's writer is closed, the runs of the others are finished.
            (logger.experiment.close if self._name == NAMES["tensorboard"] else logger.experiment.finish)()
        except Exception as error:  # whatever it is, it is not the run's
            warn(
                f"{self._name} has failed ({_first_line(error)}); the run goes on without it, the numbers are in the "
                "CSV files"
            )
            with suppress(Exception):
                if self._name != NAMES["wandb"]:
                    return
                import wandb  # here alone: it takes as long as all the rest of a recipe to import

                wandb.teardown()  # or it would tell of its death once more, when the process ends

    def _tell_divergence(self, logger: Logger, run: int, event: EpisodeDone) -> None:
        index, episode = event.diverged[run]
        if self._name == NAMES["wandb"]:
            logger.experiment.summary[f"run {run}/diverged"] = f"design {index + 1}, episode {episode + 1}"
        else:
            logger.log_scalar(f"run {run}/diverged", 1.0, step=event.env_steps)


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
