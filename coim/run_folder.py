"""What a run's folder holds: its settings, the designs tried and their best policies."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from coim.events import Kind
from coim.tables import DESIGN_PREFIX, OF_RUN, read_table

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
    """

    run: int
    number: int
    kind: Kind
    design: Tensor
    predicted: float
    best_return: float
    diverged: str = ""


def read_config(folder: Path) -> dict[str, Any]:
    """``config.json`` of a run's folder."""
    try:
        config = json.loads((folder / "config.json").read_text())
    except OSError as error:
        raise ValueError(f"{folder} holds no run: {folder / 'config.json'} cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise ValueError(f"{folder / 'config.json'} is damaged ({error}); put it back from a copy") from None
    if not isinstance(config, dict) or not {"environment", "settings"} <= config.keys():
        raise ValueError(f"{folder} holds no run: its config.json names no environment and settings")
    settings = config["settings"]
    for old in RENAMED.keys() & settings.keys():
        settings[RENAMED[old]] = settings.pop(old)
    return config


def read_designs(folder: Path) -> tuple[TriedDesign, ...]:
    """Rows of ``designs.csv``; a last line that is still being written is left out.

    Raises:
        ValueError: if somebody has changed it so that it cannot be read; see `coim.tables.read_table`.
    """
    path = folder / "designs.csv"
    rows: list[dict[str, Any]] = read_table(path, OF_RUN[path.name])
    return tuple(
        TriedDesign(
            run=row["run"],
            number=row["design"],
            kind=row["kind"],
            design=torch.tensor(
                [cell for name, cell in row.items() if name.startswith(DESIGN_PREFIX)],
                dtype=torch.float32,
                device="cpu",
            ),
            predicted=row["predicted"],
            best_return=row["best_return"],
            diverged=row.get("diverged", ""),
        )
        for row in rows
    )


def policy_path(folder: Path, number: int) -> Path:
    """Where a run keeps the policy of a design, which counts from 1."""
    return folder / "policies" / f"design-{number}.pt"
