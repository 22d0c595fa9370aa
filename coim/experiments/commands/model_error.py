"""Measure the error of the learnt dynamics during the training of one run, for Fig. 4(a) and (b).

``coim model-error ENVIRONMENT --out STUDY_FOLDER/model_error`` follows Algorithm 1 as ``coim run ENVIRONMENT`` does,
and measures on the way. The same line again goes on with a run that was stopped.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from coim.envs import BODIES
from coim.experiments.command import as_help
from coim.experiments.model_error.run import run
from coim.experiments.run.command_line import parse
from coim.experiments.run.interrupt import on_command_line


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line: the environment, two options of its own, and every setting of the environment's recipe."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    about = as_help(__doc__)
    own = argparse.ArgumentParser(prog="coim model-error", description=about, add_help=False, allow_abbrev=False)
    own.add_argument("environment", choices=BODIES)
    own.add_argument("--every", type=int, default=10, help="episodes of a design between two measurements (10)")
    own.add_argument("--rows", type=int, default=200, help="transitions in each measurement (200)")
    own.add_argument("--out", type=Path, help="folder; one that holds such a run is gone on with")
    if {"-h", "--help"} & {*given}:
        print(own.format_help())
        given = [name for name in given if name in BODIES][:1] or ["hopper"]
        given.append("--help")  # the recipe's settings follow
    asked, rest = own.parse_known_args(given)
    with on_command_line(own_process=arguments is None):
        for name in ("every", "rows"):
            if getattr(asked, name) < 1:
                raise ValueError(f"--{name} is {getattr(asked, name)}, it must be at least 1")
        words = [*folder_options(asked.out), *rest]
        # States are swapped by noisy designs too, whatever the run imagines.
        settings = parse(f"{own.prog} {asked.environment}", about, words, read=("sigma",))
        run(BODIES[asked.environment], asked.environment, settings, every=asked.every, rows=asked.rows)


def folder_options(out: Path | None) -> list[str]:
    """The recipe's own words for a folder: gone on with where there is a run, or made."""
    if out is None:
        return ["--name", "model_error"]
    return ["--resume" if (out / "config.json").exists() else "--out", str(out)]
