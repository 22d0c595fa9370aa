"""Write a policy and its body to a folder, and compare the file with torch before it is put there."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from coim.envs.blueprint import lengths, mjcf
from coim.experiments.export.actor import FORMATS, Actor
from coim.experiments.export.card import HEADING, card
from coim.experiments.export.taken import Taken
from coim.experiments.run.atomic_write import as_csv, naming_out, shortest, write_whole, written_aside
from coim.models import Policy
from coim.run_folder import read_config

STATES = 256  # random states on which a file is compared with torch
TOLERANCE = 1e-5  # largest difference of an action


def export(source: Path, taken: Taken, path: Path) -> list[Path]:
    """Write a policy, its body, and what one must know to use them.

    Args:
        source: the folder of the run.
        taken: what is written.
        path: of the policy; its suffix says the format.

    Returns:
        The files, the policy first.

    Raises:
        ValueError: if the suffix is none of a format, a package for it is not installed, the file does not act as the
            policy, the folder has a README that is not ours, or another policy there has the body's files.
        OSError: if a file cannot be written.
    """
    if path.suffix not in FORMATS:
        raise ValueError(f"--to is {path}: its suffix must be one of {', '.join(FORMATS)}")
    readme = path.parent / "README.md"
    if readme.exists() and not readme.read_text().startswith(HEADING):
        raise ValueError(f"{readme} is not of coim export, and would be lost; name another folder in --to")
    config = read_config(source)
    about = {
        "environment": config["environment"],
        "settings": taken.settings,
        "design": [float(shortest(factor)) for factor in taken.design.tolist()],
    }
    refuse_shared(path, about, readme)
    assert isinstance(taken.policy, Policy)
    with naming_out(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        with written_aside(path) as aside:
            error = write_policy(taken.policy, aside)
    robot = taken.bodies(1, seed=0)
    robot.reset(TensorDict({"design": taken.design[None]}, [1]))
    parts = lengths(robot)
    columns = list(dict.fromkeys(name for part in parts for name in part))
    about |= {"design_names": robot.design_names(), "step_seconds": robot.step_seconds}
    contents = {
        path.with_suffix(".json"): json.dumps(about, indent=2) + "\n",
        path.with_name(f"{path.stem}-body.xml"): mjcf(robot, taken.design),
        path.with_name(f"{path.stem}-lengths.csv"): as_csv(columns, parts),
        readme: card(path, taken, robot, config, error=error, states=STATES),
    }
    for place, text in contents.items():
        write_whole(place, text)
    return [path, *contents]


def refuse_shared(path: Path, about: Mapping[str, Any], readme: Path) -> None:
    """Refuse to put another body beside a policy of the folder, or another policy into its README.

    Raises:
        ValueError: with that policy and the way out.
    """
    beside = path.with_suffix(".json")
    same = [path.with_suffix(suffix) for suffix in FORMATS if suffix != path.suffix]
    described = re.findall("^`([^`]+)` drives", readme.read_text(), re.MULTILINE) if readme.exists() else []
    others = [path.with_name(name) for name in described if Path(name).stem != path.stem]
    if beside.exists() and any(about[key] != json.loads(beside.read_text()).get(key) for key in about):
        others += same
    if taken := next((other for other in others if other.exists()), None):
        raise ValueError(f"{taken} lies in this folder with a body and a README of its own; name another one in --to")


def write_policy(policy: Policy, path: Path) -> float:
    """Write a policy without a run axis, read it again, and compare the two on random states.

    Returns:
        The largest difference of an action.

    Raises:
        ValueError: if it is larger than `TOLERANCE`.
    """
    write, read = FORMATS[path.suffix]
    actor = Actor.of(policy)
    write(actor, path)
    states = actor.example(STATES)
    with torch.no_grad():
        difference = read(path)(*states) - policy.deterministic_action(*states)
    error = float(difference.abs().max())
    if not error <= TOLERANCE:  # NaN is not
        raise ValueError(
            f"the written policy acts otherwise than torch, by up to {error:.2g} instead of {TOLERANCE:g}; "
            "take another format"
        )
    return error
