"""Write the page of a run: ``coim report runs/A``, or ``runs/A runs/B`` for a comparison.

The page opens from a file, without a network. A run that is still going on can be looked at too.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import tyro

from coim.experiments.report.run_report import write_report
from coim.experiments.run.bodies import imported_body
from coim.experiments.run.interrupt import on_command_line


@dataclasses.dataclass(frozen=True, kw_only=True)
class Report:
    """Write report.html about a run, or a comparison of several."""

    folders: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders of one environment."""
    out: Path | None = None
    """The page, or a folder for it; by default report.html in the run's folder, of several runs/comparison-DATE."""
    body: str | None = None
    """Class of the body as module:Class, if it is not one of ours: else its bodies are not drawn."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    asked = tyro.cli(Report, prog="coim report", args=arguments)
    with on_command_line(own_process=arguments is None):
        print(write_report(asked.folders, out=asked.out, body=imported_body(asked.body)))
