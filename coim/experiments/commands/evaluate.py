"""Evaluate a policy of a run on a body: ``coim evaluate runs/A --design best --episodes 20``.

The deterministic policy runs episodes from different starts. Their mean and spread are printed, and each return is
written to a CSV file. A file of ``coim export`` can stand in place of the folder.
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
class Evaluate:
    """What is evaluated."""

    source: tyro.conf.Positional[Path]
    """Folder of a run, or a policy that coim export has written."""
    design: str = "best"
    """best, the number of a design of the run, from 1, or any body by its factors, as in 1,1.2,0.8,1."""
    episodes: int = 20
    """Episodes, each from its own start."""
    seed: int = 0
    """Seed of the starts."""
    policy: Literal["best", "population"] | None = None
    """best: that of the design's best evaluation. population: the one that serves every design, as it is now; the
    default, and the only one, for a body by its factors."""
    run: int | None = None
    """One of K runs; by default the one with the best return."""
    body: str | None = None
    """Class of the body as module:Class, if it is not one of ours."""
    out: Path | None = None
    """The CSV file; by default evaluation.csv in the run's folder, or beside the policy, or evaluation-2.csv, ... where
    there is one already."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    asked = tyro.cli(Evaluate, prog="coim evaluate", description=as_help(__doc__), args=arguments)
    with on_command_line(own_process=arguments is None):
        if asked.episodes < 1:
            raise ValueError(f"--episodes is {asked.episodes}, it must be at least 1")
        if asked.seed < 0:
            raise ValueError(f"--seed is {asked.seed}, it must be at least 0")
        print(f"reading {asked.source}", file=sys.stderr, flush=True)  # imports take seconds
        from coim.experiments.export.evaluation import EVALUATION, evaluate, told, write_table
        from coim.experiments.export.taken import take
        from coim.experiments.run.atomic_write import new_file

        taken = take(asked.source, asked.design, run=asked.run, policy=asked.policy, body=asked.body)
        table = evaluate(taken, episodes=asked.episodes, seed=asked.seed)
        folder = asked.source if asked.source.is_dir() else asked.source.parent
        path = asked.out or new_file(folder / EVALUATION.file)
        write_table(table, path)
        print("\n".join([*told(taken, table), str(path)]), flush=True)
