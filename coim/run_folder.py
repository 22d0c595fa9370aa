"""A run's folder: its tables, its settings, the designs tried and their best policies."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from coim.events import DesignDone, EpisodeDone, Event, Kind, running
from coim.tables import DESIGN_PREFIX, Cell, Layout, design_columns, read_table

# The tables that grow with a run. Designs and episodes count from 1, runs from 0. Functions below make their rows.
EVALUATIONS = Layout(
    file="evaluations.csv",
    columns={
        "run": int,
        "design": int,
        "kind": str,
        DESIGN_PREFIX: float,
        "episode": int,
        "training_return": float,
        "return": float,
        "env_steps": int,
        "model_error": float,
        "seconds": float,  # of wall-clock since the run began
        "diverged": str,
    },
    needed=("run", "design", "kind", "episode", "return", "env_steps"),
)
DESIGNS = Layout(
    file="designs.csv",
    columns={
        "run": int,
        "design": int,
        "kind": str,
        DESIGN_PREFIX: float,
        "predicted": float,
        "best_return": float,
        "diverged": str,
    },
    needed=("run", "design", "kind", "predicted", "best_return"),
)
EXPECTED = ("expected", "deviation")  # columns of designs.csv where a posterior over returns has chosen the bodies
METRICS = Layout(  # and a column for each metric, and for the seconds of each part of an episode
    file="metrics.csv",
    columns={"run": int, "design": int, "episode": int, "diverged": str},
    needed=("run", "design", "episode"),
)
Row = dict[str, Cell | None]

# Settings that older runs have under another name.
RENAMED = {"designs": "imagine"}


@dataclass(frozen=True, eq=False)
class TriedDesign:
    """A row of ``designs.csv``.

    Attributes:
        run: in ``0 .. K - 1``.
        number: 1 for the first, as in the files.
        kind: one of the first designs, the optimum of Eq. 5, a random one, or the one body of a run with a fixed body.
        design: ``[D]``.
        predicted: Eq. 5 before the body was built; NaN where there was no start state yet.
        best_return: highest evaluation return.
        diverged: where the run diverged on this design, as ``design 2, episode 1``, and ``best_return`` is the highest
            until then; empty where it did not.

    Example:
        >>> tried = TriedDesign(0, 6, "optimised", torch.tensor([1.2, 0.8, 1.9, 0.6]), 31.5, best_return=910.0)
        >>> tried.number, tried.best_return, bool(tried.diverged)
        (6, 910.0, False)
    """

    run: int
    number: int
    kind: Kind
    design: Tensor
    predicted: float
    best_return: float
    diverged: str = ""


def read_config(folder: Path) -> dict[str, Any]:
    """Read ``config.json`` of a run's folder.

    Raises:
        ValueError: if it does not exist, is damaged, or names no environment and settings.
    """
    try:
        config = json.loads((folder / "config.json").read_text())
    except OSError as error:
        raise ValueError(
            f"{folder} holds no run: {folder / 'config.json'} cannot be read ({error.strerror}); name a run folder"
        ) from None
    except ValueError as error:
        raise ValueError(f"{folder / 'config.json'} is damaged ({error}); put it back from a copy") from None
    if not isinstance(config, dict) or not {"environment", "settings"} <= config.keys():
        raise ValueError(f"{folder} holds no run: its config.json names no environment and settings; name a run folder")
    settings = config["settings"]
    for old in RENAMED.keys() & settings.keys():
        settings[RENAMED[old]] = settings.pop(old)
    return config


def read_designs(folder: Path) -> tuple[TriedDesign, ...]:
    """Read the rows of ``designs.csv``; a last line that is still being written is left out.

    Raises:
        ValueError: if somebody has changed it so that it cannot be read; see `coim.tables.read_table`.
    """
    table: dict[str, list[Any]] = read_table(folder / DESIGNS.file, DESIGNS)
    entries = [cells for name, cells in table.items() if name.startswith(DESIGN_PREFIX)]
    names = ("run", "design", "kind", "predicted", "best_return", "diverged")
    return tuple(
        TriedDesign(
            run=run,
            number=number,
            kind=kind,
            design=torch.tensor(design, dtype=torch.float32, device="cpu"),
            predicted=predicted,
            best_return=best_return,
            diverged=diverged,
        )
        for (run, number, kind, predicted, best_return, diverged), design in zip(
            zip(*(table[name] for name in names)), zip(*entries)
        )
    )


def evaluation_rows(event: EpisodeDone, design_names: Sequence[str], seconds: float) -> list[Row]:
    """Rows of ``evaluations.csv`` after an episode, one for each run that learns or diverged in it.

    Args:
        event: the episode.
        design_names: names of the D entries of a design.
        seconds: of wall-clock since the run began.
    """
    error = event.metrics.get("model_error")
    return [
        {
            "run": run,
            "design": event.index + 1,
            "kind": event.kind,
            **dict(zip(design_columns(design_names), event.design[run].tolist())),
            "episode": event.episode + 1,
            "training_return": float(event.training_return[run]),
            "return": float(event.evaluation_return[run]),
            "env_steps": event.env_steps,
            "model_error": None if error is None else float(error[run]),
            "seconds": seconds,
            "diverged": where_diverged(event, run),
        }
        for run in running(event)
    ]


def design_rows(
    event: DesignDone, design_names: Sequence[str], told: Mapping[str, Sequence[float | None]]
) -> list[Row]:
    """Rows of ``designs.csv`` after the last episode of a design, one for each run that tried it.

    Args:
        event: the design.
        design_names: names of the D entries of a design.
        told: what was said of the design before it was built, by column, for each of the K runs: ``predicted``, Eq. 5,
            and where a posterior has chosen the ``expected`` return with its ``deviation``; None where nothing was.
    """
    return [
        {
            "run": run,
            "design": event.index + 1,
            "kind": event.kind,
            **dict(zip(design_columns(design_names), event.design[run].tolist())),
            "best_return": float(event.best_return[run]),
            **{name: values[run] for name, values in told.items()},
            "diverged": where_diverged(event, run),
        }
        for run in running(event)
    ]


def metric_rows(event: EpisodeDone) -> list[Row]:
    """Rows of ``metrics.csv`` after an episode; the seconds are those of all runs together, the same in each row."""
    parts = sorted(event.seconds)  # learners side by side book theirs in the order in which they end
    return [
        {
            "run": run,
            "design": event.index + 1,
            "episode": event.episode + 1,
            **{name: float(values[run]) for name, values in event.metrics.items()},
            **{f"seconds/{part}": event.seconds[part] for part in parts},
            "diverged": where_diverged(event, run),
        }
        for run in running(event)
    ]


def where_diverged(event: Event, run: int) -> str | None:
    """Where a run diverged, as ``design 2, episode 1``; None for one that learns."""
    if run not in event.diverged:
        return None
    index, episode = event.diverged[run]
    return f"design {index + 1}, episode {episode + 1}"


def policy_path(folder: Path, number: int) -> Path:
    """Where a run keeps the policy of a design, which counts from 1."""
    return folder / "policies" / f"design-{number}.pt"
