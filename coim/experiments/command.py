"""The command ``coim``: its words, and what each of them runs."""

from __future__ import annotations

import os
import re
import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from types import FrameType

COMMANDS = {
    "run": "co-adapt a body and its controller",
    "resume": "go on with a run from its last checkpoint",
    "study": "compute many runs that are compared",
    "report": "write the page of a run, or of several side by side",
    "watch": "film a run's policies on its bodies",
    "evaluate": "run a policy for some episodes: mean, spread, and a CSV file",
    "export": "write a policy and its body for other programs",
    "dataset": "write the transitions of a run as a Minari dataset",
    "atlas": "write a page with every body of a run, and a robot that walks in it",
    "figures": "draw the figures of a study",
    "retrain": "train the best bodies of a study again from scratch",
    "archive": "copy the tables of a study, without its checkpoints",
    "check": "show what this machine has, and what will be slow or missing",
    "model-error": "measure the error of the learnt dynamics during a run",
}


def main() -> None:
    """Run the word that stands first on the command line of this process.

    Raises:
        SystemExit: 0 after the help, 2 for an unknown word, 1 if the extra ``experiments`` is not installed.
    """
    mind_ctrl_c()
    words = sys.argv[1:]
    if not words or words[0] in ("-h", "--help"):
        print(usage())
        return
    name, *rest = words
    if name not in COMMANDS:
        print(f"coim: there is no {name!r}; it must be one of {', '.join(COMMANDS)}", file=sys.stderr)
        sys.exit(2)
    try:
        module = import_module(f"coim.experiments.commands.{name.replace('-', '_')}")
    except ModuleNotFoundError as error:
        if (error.name or "coim").split(".")[0] == "coim":
            raise
        sys.exit(f"coim {name} needs the package {error.name}: pip install 'coim[experiments]'")
    sys.argv = [f"coim {name}", *rest]
    module.main()


def usage() -> str:
    """The help of the command itself."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:{width}}  {what}" for name, what in COMMANDS.items()]
    return "\n".join(["usage: coim WORD ...", "", *lines, "", "coim WORD --help lists what each of them takes."])


def as_help(docstring: str | None) -> str:
    """A docstring without the markup of its source, as the description of a command.

    Example:
        >>> as_help("Draw a study: ``coim figures FOLDER``.")
        'Draw a study: coim figures FOLDER.'
    """
    linked = re.sub(r"`([^`<]+) <([^>]+)>`_", r"\1 (\2)", docstring or "")
    return re.sub(r"(:\w+:)?`+", "", linked)


def mind_ctrl_c() -> None:
    """End at Ctrl-C with one line while a command imports what it needs; not where Ctrl-C is ignored or handled.

    An exception could be lost: libraries catch what fails while they are imported, and Python passes over what is
    raised in a callback. From then on see `coim.experiments.run.interrupt`.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end_at_ctrl_c)


def end_at_ctrl_c(signum: int, frame: FrameType | None) -> None:
    """End the process at once: nothing has begun that would have to be put away."""
    os.write(2, b"\nstopped by Ctrl-C\n")
    os._exit(128 + signum)


def as_words(arguments: Sequence[str] | None) -> list[str]:
    """Arguments of a command: those given, or those of this process."""
    return list(sys.argv[1:] if arguments is None else arguments)
