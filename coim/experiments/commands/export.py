"""Write a policy of a run and its body for other programs: ``coim export runs/A --design best --to out/policy.onnx``.

The file takes an observation and a design and returns the deterministic action. Beside it are the body as an MJCF file,
its lengths in metres, and a README that says what each entry is. The file is compared with torch before it is put in
its place.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import tyro

from coim.experiments.command import as_help
from coim.experiments.run.interrupt import on_command_line


@dataclasses.dataclass(frozen=True, kw_only=True)
class Export:
    """What is written, and where."""

    folder: tyro.conf.Positional[Path]
    """Folder of a run."""
    to: Path
    """The policy's file: .onnx, .pt2 (torch.export) or .safetensors. What belongs to it is written beside it."""
    design: str = "best"
    """best, the number of a design of the run, from 1, or any body by its factors, as in 1,1.2,0.8,1."""
    policy: Literal["best", "population"] | None = None
    """best: that of the design's best evaluation. population: the one that serves every design, as it is now; the
    default, and the only one, for a body by its factors."""
    run: int | None = None
    """One of K runs; by default the one with the best return."""
    body: str | None = None
    """Class of the body as module:Class, if it is not one of ours."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    asked = tyro.cli(Export, prog="coim export", description=as_help(__doc__), args=arguments)
    with on_command_line(own_process=arguments is None):
        print(f"reading {asked.folder}", file=sys.stderr, flush=True)  # imports take seconds
        from coim.experiments.export.taken import take
        from coim.experiments.export.write import export

        if not asked.folder.is_dir():
            raise ValueError(f"{asked.folder} is no folder; name that of a run")
        taken = take(asked.folder, asked.design, run=asked.run, policy=asked.policy, body=asked.body)
        for path in export(asked.folder, taken, asked.to):
            print(path, flush=True)
