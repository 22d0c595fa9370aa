"""The policy that is asked for, with its body: from the folder of a run, or from a file that was exported."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor

from coim.envs import BODIES, MorphEnv
from coim.experiments.export.actor import INPUTS, OUTPUT, read_policy
from coim.experiments.run.bodies import imported_body, opened
from coim.models import Policy, select_run
from coim.run_folder import TriedDesign
from coim.saved_run import SavedRun

Which = Literal["best", "population"]


@dataclass(frozen=True, eq=False)
class Taken:
    """A policy and the body that it drives.

    Attributes:
        policy: reads ``observation`` and ``design``, writes ``action``; without a run axis.
        body: class of the body.
        design: ``[D]``.
        settings: ``task`` and ``episode_steps`` of its episodes.
        name: of the design, for a reader.
        source: the folder or file that it is from.
        of: whose policy it is: ``best`` or ``population``; empty for a file.
        run: one of K; None for a file.
        tried: the design's row in the run; None for lengths that are none of its designs.
    """

    policy: Policy | TensorDictModule
    body: type[MorphEnv]
    design: Tensor
    settings: dict[str, Any]
    name: str
    source: Path
    of: str
    run: int | None
    tried: TriedDesign | None

    def bodies(self, number: int, *, seed: int) -> MorphEnv:
        """Equal environments in lock-step for this policy, on the CPU; their first reset is to be given the design."""
        return self.body(num_runs=number, seed=seed, device="cpu", **self.settings)


def take(source: Path, design: str, *, run: int | None, policy: Which | None, body: str | None) -> Taken:
    """The policy and the body that a command line names.

    Args:
        source: a run folder, or a file of ``coim export``.
        design: ``best``, the number of a design of the run, or D factors with commas between them.
        run: one of K runs; None takes the one with the best return.
        policy: that of the design's best evaluation or the population's. None takes the first where there is one: other
            lengths than those that the run has built have the population's alone.
        body: class of the body as module:Class, if it is none of ours.

    Raises:
        ValueError: if there is no such run, design, policy, file or body.
    """
    if not source.is_dir() and (source.is_file() or source.suffix):
        return _from_file(source, design, body)
    loaded = opened(source, body, run=run)
    lengths = numbers(design, loaded.bodies) if "," in design else None
    if lengths is not None and policy == "best":
        raise ValueError(f"--design {design} is no design of the run, so it has no best policy: --policy population")
    if lengths is None and design != "best" and not design.isdecimal():
        raise ValueError(f"--design is {design!r}: choose best, the number of a design, or factors such as 1,1.2,0.8,1")
    number = int(design) if design.isdecimal() else None
    own = lengths is None and policy != "population"
    if own:
        trained = loaded.trained(number)
        tried, chosen = trained.tried, trained.policy
    else:
        tried = loaded.highest(number)
        chosen = loaded.population.policy
        chosen = chosen if chosen.num_runs is None else select_run(chosen, tried.run)
    named = f"design {tried.number} ({tried.kind})" if lengths is None else f"body {design}"
    if not own:
        named += ", the population's policy"
    return Taken(
        policy=chosen.cpu(),
        body=type(loaded.bodies),
        design=tried.design if lengths is None else lengths,
        settings=_episodes(loaded),
        name=named,
        source=source,
        of="best" if own else "population",
        run=tried.run,
        tried=tried if own else None,  # its best return is its own policy's
    )


def numbers(design: str, bodies: MorphEnv) -> Tensor:
    """The factors on a command line, ``[D]``.

    Raises:
        ValueError: if one is no number, there are too many or too few, or one leaves its bounds.
    """
    names = bodies.design_names()
    try:
        given = torch.tensor([float(word) for word in design.split(",")], dtype=torch.float32)
    except ValueError:
        raise ValueError(f"--design is {design!r}: one of its entries is no number, such as in 1,1.2,0.8,1") from None
    low, high = (end.float() for end in bodies.design_bounds())
    if len(given) != len(names) or not bool(((given >= low) & (given <= high)).all()):
        ranges = ", ".join(f"{name} in [{least:g}, {most:g}]" for name, least, most in zip(names, low, high))
        raise ValueError(f"--design is {design}, it must be {len(names)} factors: {ranges}")
    return given


def _episodes(loaded: SavedRun) -> dict[str, Any]:
    return {name: loaded.settings[name] for name in ("task", "episode_steps")}


def _from_file(path: Path, design: str, body: str | None) -> Taken:
    """A policy that was exported, and by default its own body."""
    act, beside = read_policy(path), path.with_suffix(".json")
    try:
        told = json.loads(beside.read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{beside} cannot be read ({error}), it says which body {path.name} drives") from None
    kind = imported_body(body) or BODIES.get(told["environment"])
    if kind is None:
        raise ValueError(f"{told['environment']!r} is none of {', '.join(BODIES)}; name its class with --body")
    own = torch.tensor(told["design"], dtype=torch.float32)
    if design != "best" and "," not in design:
        raise ValueError(f"--design is {design!r}: {path} has one body, best, or give factors such as 1,1.2,0.8,1")
    return Taken(
        policy=TensorDictModule(act, in_keys=list(INPUTS), out_keys=[OUTPUT]),
        body=kind,
        design=own if design == "best" else numbers(design, kind(device="cpu")),
        settings=told["settings"],
        name=f"{path.name} on its own body" if design == "best" else f"{path.name} on body {design}",
        source=path,
        of="",
        run=None,
        tried=None,
    )
