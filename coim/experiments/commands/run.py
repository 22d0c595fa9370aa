"""Co-adapt a body and its controller: ``coim run hopper``, and the settings behind it."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from coim.envs import BODIES
from coim.experiments import train
from coim.experiments.command import as_words


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line: the environment, and every setting of a run."""
    words = as_words(arguments)
    if not words or words[0] in ("-h", "--help"):
        print(f"usage: coim run ENVIRONMENT ...\n\nenvironments: {', '.join(BODIES)}\n")
        print("coim run hopper --help lists every setting.")
        return
    name, *rest = words
    if name not in BODIES:
        print(f"coim run: there is no environment {name!r}; it must be one of {', '.join(BODIES)}", file=sys.stderr)
        sys.exit(2)
    if arguments is None:
        sys.argv[1:] = rest
    train.main(BODIES[name], name, None if arguments is None else rest)
