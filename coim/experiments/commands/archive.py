"""Copy the small part of a study, to keep beside its figures: ``coim archive STUDY_FOLDER TARGET``.

The copy has the study's ledger, and the settings and tables of every run that is over. It has no checkpoints, no
networks, no logs, and no paths of this machine. ``coim figures TARGET`` draws every figure again. A copy of TARGET is
a study's folder, in which ``coim study`` computes the runs that are missing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import tyro

from coim.experiments.command import as_help
from coim.experiments.run.interrupt import on_command_line
from coim.experiments.study.archive import archive


@dataclasses.dataclass(frozen=True, kw_only=True)
class Archive:
    """Copy the small part of a study."""

    study: tyro.conf.Positional[Path]
    """Folder of the study."""
    target: tyro.conf.Positional[Path]
    """Folder to write to; what an earlier archive left there is replaced."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    asked = tyro.cli(Archive, prog="coim archive", description=as_help(__doc__), args=arguments)
    with on_command_line(own_process=arguments is None):
        kept = archive(asked.study, asked.target)
    print(f"{len(kept)} runs kept in {asked.target}; to draw them: coim figures {asked.target}")
