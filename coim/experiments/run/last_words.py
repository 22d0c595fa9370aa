"""Command lines that a run tells its user: what films its best body, and what trains that body anew."""

from __future__ import annotations

import dataclasses
import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from coim.envs import BODIES, MorphEnv
from coim.experiments.run.atomic_write import shortest
from coim.experiments.run.effect import without_effect
from coim.experiments.run.records import number
from coim.experiments.run.settings import PRESETS, Settings, option
from coim.run_folder import TriedDesign, read_designs


def plain_sac(settings: Settings, design: Sequence[float], **changed: Any) -> Settings:
    """The settings of a run, less population, imagination and search: plain SAC on one body, from scratch.

    Args:
        settings: of a run.
        design: the body, ``[D]``.
        changed: settings that are to have other values besides.
    """
    alone: dict[str, Any] = {"imagine": "none", "dream": "ensemble", "bodies": "search", "num_designs": 1}
    alone |= {"num_runs": 1, "population_updates": 0, "model_updates": 0}
    alone |= {"individual_mix": 0.0, "individual_imagined_share": 0.0}
    alone |= {"out": None, "resume": None, "name": "retrained", "log": "off", "wandb": "off"}
    return dataclasses.replace(settings, first_design=tuple(design), **alone | changed)


def options(settings: Settings) -> list[str]:
    """Words of a recipe's command line that give these settings, less those that change nothing, which it refuses.

    Example:
        >>> options(Settings(compile=True, native_episodes=True, seed=3, num_cells=(64, 64)))
        ['--seed', '3', '--num-cells', '64', '64']
    """
    default, idle = PRESETS[settings.preset], without_effect(settings)
    words = [] if settings.preset == Settings.preset else ["--preset", settings.preset]
    for field in dataclasses.fields(Settings):
        value = getattr(settings, field.name)
        if field.name == "preset" or field.name in idle or value == getattr(default, field.name):
            continue
        if isinstance(value, bool):
            words.append(option(field.name if value else f"no_{field.name}"))
        else:
            words += [option(field.name), *map(str, value if isinstance(value, tuple) else (value,))]
    return words


def best_of(folder: Path) -> TriedDesign | None:
    """The design with the highest return of all runs in a folder."""
    tried = [design for design in read_designs(folder) if math.isfinite(design.best_return)]
    return max(tried, key=lambda design: design.best_return, default=None)


def last_words(folder: Path, name: str, body: type[MorphEnv], settings: Settings) -> list[str]:
    """Lines at the end of a run: its best body, and the commands that film it and train it anew.

    Args:
        folder: of the run.
        name: of the recipe.
        body: the environment.
        settings: of the run.
    """
    best = best_of(folder)
    if best is None:
        return []
    fleet = settings.num_runs > 1
    of_run = f" of run {best.run}" if fleet else ""
    lines = [
        f"best body: design {best.number}{of_run} ({best.kind}), return {number(best.best_return)}: "
        + ", ".join(in_names(best.design.tolist(), body))
    ]
    if BODIES.get(name) is body:  # another body has no recipe of this name
        film = [
            "coim",
            "watch",
            str(folder),
            "--design",
            str(best.number),
            *(["--run", str(best.run)] if fleet else []),
        ]
        design = [float(shortest(xi)) for xi in best.design.tolist()]
        alone = plain_sac(settings, design, name=PRESETS[settings.preset].name)  # --out may be put behind it
        lines.append(f"to film it: {shlex.join(film)}")
        if settings.num_designs > 1:
            anew = shlex.join(["coim", "run", name, *options(alone)])
            lines.append(f"to train it anew, by SAC alone: {anew}")
    return lines


def in_names(design: Sequence[float], body: type[MorphEnv]) -> list[str]:
    """The entries of a design for a reader.

    Example:
        >>> from coim import HopperMorph
        >>> in_names([1.0, 0.5, 1.23456, 2.0], HopperMorph)
        ['torso 1', 'thigh 0.5', 'shank 1.235', 'foot 2']
    """
    return [f"{name} {number(xi)}" for name, xi in zip(body.design_names(), design)]
