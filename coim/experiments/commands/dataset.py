"""Write the transitions of a run as a Minari dataset: ``coim dataset runs/A --name coim/hopper/first-v0``.

Offline reinforcement learning reads it by ``minari.load_dataset``. Observations end with the design.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

import tyro

from coim.experiments.command import as_help
from coim.experiments.run.interrupt import on_command_line


@dataclasses.dataclass(frozen=True, kw_only=True)
class Dataset:
    """What is written, and under which name."""

    folder: tyro.conf.Positional[Path]
    """Folder of a run, with its checkpoint."""
    name: str
    """Name of the dataset as Minari has it: (namespace/)name-v0."""
    run: int | None = None
    """One of K runs; by default the episodes of all."""
    body: str | None = None
    """Class of the body as module:Class, if it is not one of ours."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    asked = tyro.cli(Dataset, prog="coim dataset", description=as_help(__doc__), args=arguments)
    with on_command_line(own_process=arguments is None):
        print(f"reading {asked.folder}", file=sys.stderr, flush=True)  # imports take seconds
        from coim.experiments.export.dataset import write_dataset

        written = write_dataset(asked.folder, asked.name, run=asked.run, body=asked.body)
        print(f"{written.total_episodes} episodes, {written.total_steps} steps", flush=True)
        print(written.storage.data_path.parent, flush=True)
