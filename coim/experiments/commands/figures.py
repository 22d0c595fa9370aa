"""The figures and the statistics of a study: ``coim figures STUDY_FOLDER``.

A folder in which there is only a measured run, ``model_error/``, has Fig. 4 alone.

Everything is read from the study's folder, at any state of it, and written to its ``figures/``: each figure as PNG and
PDF, the numbers that it shows as CSV, short tables as Markdown too, and ``README.md`` with all of them and captions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import tyro

from coim.experiments.command import as_help
from coim.experiments.figures.write import write_figures
from coim.experiments.run.interrupt import on_command_line


@dataclasses.dataclass(frozen=True, kw_only=True)
class Figures:
    """Draw what a study's folder holds."""

    study: tyro.conf.Positional[Path]
    """Folder of the study."""
    out: Path | None = None
    """Folder for the figures; by default figures/ in the study's."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    asked = tyro.cli(Figures, prog="coim figures", description=as_help(__doc__), args=arguments)
    with on_command_line(own_process=arguments is None):
        for plot in write_figures(asked.study, asked.out):
            place = (asked.out or asked.study / "figures") / plot.name
            print(f"{place}: {'nothing to draw. ' + plot.caption if plot.figure is None else 'written'}")
