"""The command line of a run."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Literal

import tyro
from pydantic import ValidationError

from coim.experiments.run.effect import refuse_without_effect, without_effect
from coim.experiments.run.pydantic_errors import sentence
from coim.experiments.run.resume import refuse_changes, saved_settings
from coim.experiments.run.settings import FIELDS, METHODS, PRESETS, Settings, given, option
from coim.run_folder import RENAMED


@dataclasses.dataclass(frozen=True, kw_only=True)
class Written(Settings):
    """Settings as they are written on a command line: not validated, so that an error can name the option."""

    method: Literal["paper", "grounded", "returns"] | None = None
    """Way to choose the next body. paper: maximise Eq. 5 as printed. returns: Bayesian optimisation, a Gaussian process
    over the returns earned so far. grounded: that with Eq. 5 over visited states as its mean, at first near the best
    body and then further away. By default that of the preset: returns in quick."""

    def __post_init__(self) -> None:
        pass


def parse(
    program: str, description: str, arguments: Sequence[str] | None = None, *, read: Collection[str] = ()
) -> Settings:
    """Read the command line; ``--preset`` and ``--method`` only move the defaults of everything else.

    Args:
        program: shown in the usage line.
        description: shown in the help.
        arguments: instead of ``sys.argv[1:]``.
        read: settings that the program reads for purposes of its own, whether or not they change the run.

    Raises:
        SystemExit: on an unknown option or value, or one that would change nothing, with a sentence on standard error.
        ValueError: if the folder to resume holds no run, or a setting was changed that its past depends on.
    """
    arguments = renamed(sys.argv[1:] if arguments is None else arguments)
    first = argparse.ArgumentParser(prog=program, usage="%(prog)s [OPTIONS]", add_help=False, allow_abbrev=False)
    first.add_argument("--preset", default="paper")
    first.add_argument("--method")
    first.add_argument("--resume", type=Path)
    known = first.parse_known_args(arguments)[0]
    # An unknown name is refused below, with those that exist.
    default = PRESETS.get(known.preset, PRESETS["paper"])
    if known.resume is not None:
        default = saved_settings(known.resume)
    before, default = default, Written(**vars(default) | METHODS.get(known.method, {}))
    written = tyro.cli(Written, prog=program, description=description, args=arguments, default=default)
    try:
        settings = Settings(**{name: value for name, value in vars(written).items() if name in FIELDS})
        refuse_without_effect(settings, given(arguments), called=option, read=read)
        refuse_idle_method(known.method, settings)
    except ValueError as error:
        refused = error.__cause__
        first.error(sentence(refused, Settings, called=option) if isinstance(refused, ValidationError) else str(error))
    if known.resume is not None:
        refuse_changes(before, settings)
    return settings


def refuse_idle_method(method: str | None, settings: Settings) -> None:
    """Refuse a method beside settings that let it change nothing.

    Raises:
        ValueError: with a sentence.
    """
    if method is not None and "chosen_by" in without_effect(settings):
        raise ValueError(f"--method {method} has no effect with --bodies {settings.bodies}; leave it out")


def renamed(words: Sequence[str]) -> list[str]:
    """Words of a command line with today's names of options, after a warning for each old one.

    Example:
        >>> renamed(["--imagine", "none", "--seed=3"])
        ['--imagine', 'none', '--seed=3']
    """
    found = list(words)
    for index, word in enumerate(found):
        name, *value = word.split("=", 1)
        if name.removeprefix("--") in RENAMED and name.startswith("--"):
            now = option(RENAMED[name.removeprefix("--")])
            print(f"warning: {name} is called {now} now; the next release knows {now} alone", file=sys.stderr)
            found[index] = "=".join([now, *value])
    return found
