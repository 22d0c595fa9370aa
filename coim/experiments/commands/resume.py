"""Go on with a run: ``coim resume FOLDER``, and the settings that may change on the way."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from coim.envs import BODIES
from coim.experiments import train
from coim.experiments.command import as_words
from coim.experiments.run.interrupt import on_command_line
from coim.run_folder import read_config


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line: the folder of a run, and what `coim run` takes."""
    words = as_words(arguments)
    if not words or words[0] in ("-h", "--help"):
        print("usage: coim resume FOLDER ...\n\ncoim run ENVIRONMENT --help lists the settings; more designs by")
        print("--num-designs, for example, are computed behind those that are there.")
        return
    folder, *rest = words
    with on_command_line(own_process=arguments is None):
        name = read_config(Path(folder))["environment"]
        if name not in BODIES:
            raise ValueError(
                f"{folder} holds a run of {name}, not of {', '.join(BODIES)}; resume it by the program that made it"
            )
    rest = ["--resume", folder, *rest]
    if arguments is None:
        sys.argv[1:] = rest
    train.main(BODIES[name], name, None if arguments is None else rest)
