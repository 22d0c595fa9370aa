"""A study in small, to keep beside its figures: ``coim archive STUDY_FOLDER TARGET``.

Of every run that is over, its settings and its tables; of the study, its ledger. No checkpoints, no networks, no logs,
and no paths of the machine that it was made on. ``coim figures TARGET`` draws every figure again, and a
copy of TARGET is a study's folder, in which ``coim.experiments.commands.study`` makes the runs that are missing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import tyro

from coim.experiments.run.interrupt import on_command_line
from coim.experiments.study.archive import archive


@dataclasses.dataclass(frozen=True, kw_only=True)
class Archive:
    """Keep a study in small."""

    study: tyro.conf.Positional[Path]
    """Folder of the study."""
    target: tyro.conf.Positional[Path]
    """Folder to write to; what an earlier archive left there is replaced."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    asked = tyro.cli(Archive, prog="coim archive", description=__doc__, args=arguments)
    with on_command_line(own_process=arguments is None):
        kept = archive(asked.study, asked.target)
    print(f"{len(kept)} runs kept in {asked.target}; to draw them: coim figures {asked.target}")
