"""A run's folder: the settings, and three CSV files that grow."""

from __future__ import annotations

import csv
import dataclasses
import datetime
import json
import platform
import subprocess
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from coim import DesignChosen, DesignDone, EpisodeDone
from recipes.settings import Settings

PACKAGES = ("coim", "torch", "torchrl", "tensordict", "mujoco", "pyswarms", "numpy")


class Results:
    """Writes what happens in a run to its folder, row by row as it comes.

    Designs and episodes count from 1, runs from 0.

    Args:
        folder: made if it does not exist.
        environment: name of the body, for ``config.json``.
        settings: of the run, for ``config.json``.
        design_size: D.

    Raises:
        FileExistsError: if the folder already holds anything; nothing in it is touched.
    """

    def __init__(self, folder: Path, environment: str, settings: Settings, design_size: int) -> None:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise FileExistsError(f"{folder} already holds something; name another folder with --out, or move it away")
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self._predicted: Sequence[float | None] = []
        (folder / "config.json").write_text(json.dumps(describe(environment, settings), indent=2) + "\n")
        xi = [f"xi_{i + 1}" for i in range(design_size)]
        self._evaluations = Table(
            folder / "evaluations.csv",
            [
                "run",
                "design",
                "kind",
                *xi,
                "episode",
                "training_return",
                "return",
                "env_steps",
                "model_error",
                "seconds",
            ],
        )
        self._designs = Table(folder / "designs.csv", ["run", "design", "kind", *xi, "predicted", "best_return"])
        self._metrics: Table | None = None  # its columns are known when the first episode is done

    def write(self, event: DesignChosen | EpisodeDone | DesignDone, seconds: float) -> None:
        """Append the rows of one event; ``seconds`` is the wall-clock of the run so far."""
        if isinstance(event, DesignChosen):
            nothing = [None] * len(event.design)
            self._predicted = nothing if event.predicted is None else event.predicted.tolist()
        elif isinstance(event, EpisodeDone):
            nothing = [None] * len(event.design)
            errors = event.metrics["model_error"].tolist() if "model_error" in event.metrics else nothing
            returns = event.training_return.tolist(), event.evaluation_return.tolist()
            self._evaluations.append(
                [run, event.index + 1, event.kind, *xi, event.episode + 1, *scores, event.env_steps, error, seconds]
                for run, (xi, *scores, error) in enumerate(zip(event.design.tolist(), *returns, errors))
            )
            self._write_metrics(event)
        else:
            self._designs.append(
                [run, event.index + 1, event.kind, *xi, predicted, best]
                for run, (xi, predicted, best) in enumerate(
                    zip(event.design.tolist(), self._predicted, event.best_return.tolist())
                )
            )

    def _write_metrics(self, event: EpisodeDone) -> None:
        """Append what was measured while learning; ``seconds`` are of all runs together, the same in each row."""
        if self._metrics is None:
            columns = ["run", "design", "episode", *event.metrics, *(f"seconds/{part}" for part in event.seconds)]
            self._metrics = Table(self.folder / "metrics.csv", columns)
        seconds = list(event.seconds.values())
        self._metrics.append(
            [
                run,
                event.index + 1,
                event.episode + 1,
                *(float(values[run]) for values in event.metrics.values()),
                *seconds,
            ]
            for run in range(len(event.design))
        )

    def table(self) -> str:
        """The designs and their best returns, for a terminal."""
        with self._designs.path.open(newline="") as file:
            return "\n".join(format_row(row) for row in csv.reader(file))


class Table:
    """A CSV file that grows; every append is on disk before the next line of the program."""

    def __init__(self, path: Path, columns: list[str]) -> None:
        self.path = path
        with path.open("w", newline="") as file:
            csv.writer(file).writerow(columns)

    def append(self, rows: Iterable[Sequence[Any]]) -> None:
        with self.path.open("a", newline="") as file:
            csv.writer(file).writerows([[_cell(value) for value in row] for row in rows])


def format_row(row: Sequence[str]) -> str:
    """Cells of one width; numbers with four significant digits."""
    cells = []
    for cell in row:
        try:
            cells.append(cell if cell.isdigit() else f"{float(cell):.4g}")
        except ValueError:
            cells.append(cell or "-")
    return "  ".join(cell.rjust(9) for cell in cells)


def _cell(value: Any) -> Any:
    """Seven significant digits hold a float32; a missing value is an empty cell."""
    return f"{value:.7g}" if isinstance(value, float) else "" if value is None else value


def describe(environment: str, settings: Settings) -> dict[str, Any]:
    """Everything that somebody needs to repeat the run."""
    return {
        "environment": environment,
        "settings": {key: _plain(value) for key, value in dataclasses.asdict(settings).items()},
        "versions": {"python": platform.python_version()} | {name: version(name) for name in PACKAGES},
        "machine": {"processor": platform.processor() or platform.machine(), "system": platform.platform()},
        "revision": git_revision(),
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def _plain(value: Any) -> Any:
    return str(value) if isinstance(value, Path) else value


def git_revision() -> str | None:
    """Commit of the checkout that this file lies in, with ``-dirty`` where it was changed; None outside of one."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def default_folder(environment: str, settings: Settings) -> Path:
    """``runs/ENVIRONMENT-DATE-NAME``; the date has seconds, so that runs started by hand do not collide."""
    date = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    return Path("runs") / f"{environment}-{date}-{settings.name}"
