"""The README of an exported policy: how to call it, what it was trained on, how it was made."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from coim.envs import MorphEnv
from coim.envs.blueprint import motors, observed
from coim.experiments.export.taken import Taken
from coim.experiments.run.atomic_write import shortest
from coim.experiments.run.records import number

HEADING = "# A policy of coim and its body"
CALLS = {
    ".onnx": """import numpy as np, onnxruntime

session = onnxruntime.InferenceSession("{file}")
observation, design = np.zeros((1, {states}), np.float32), np.array([[{design}]], np.float32)
(action,) = session.run(["action"], {{"observation": observation, "design": design}})""",
    ".pt2": """import torch

act = torch.export.load("{file}").module()
action = act(torch.zeros(1, {states}), torch.tensor([[{design}]]))""",
    ".safetensors": """import torch
from coim.experiments.export.actor import read_policy
from pathlib import Path

act = read_policy(Path("{file}"))  # tensors: scale, centre, reach, and weight.i, bias.i of each layer
action = act(torch.zeros(1, {states}), torch.tensor([[{design}]]))""",
}


def card(path: Path, taken: Taken, robot: MorphEnv, config: dict[str, Any], *, error: float, states: int) -> str:
    """The text of the README.

    Args:
        path: of the policy.
        taken: policy and body.
        robot: one body of that design.
        config: ``config.json`` of the run.
        error: largest difference between the file's actions and torch's.
        states: how many random states it is the largest of.
    """
    names, low_high = robot.design_names(), zip(*(end.tolist() for end in robot.design_bounds()))
    design = [shortest(factor) for factor in taken.design.tolist()]
    seen, moved = observed(robot), list(motors(robot))
    returned = "none: no design of the run" if taken.tried is None else number(taken.tried.best_return)
    call = CALLS[path.suffix].format(file=path.name, states=len(seen), design=", ".join(design))
    return "\n".join(
        [
            HEADING,
            "",
            f"`{path.name}` drives the `{config['environment']}` of {taken.name}. It takes two inputs, float32, of any "
            f"batch size: `observation [B, {len(seen)}]` and `design [B, {len(design)}]`. Its output is the "
            f"deterministic action, `action [B, {len(moved)}]`: the mode of the policy's tanh-Gaussian.",
            "",
            f"```python\n{call}\n```",
            "",
            "| fact | value |",
            "|---|---|",
            f"| control step | {robot.step_seconds:g} s: one action is held for {robot.FRAME_SKIP} steps of MuJoCo |",
            f"| task | {taken.settings['task']}, episodes of {taken.settings['episode_steps']} steps |",
            f"| best return in the run | {returned} |",
            f"| written file against torch | at most {error:.1e} off in any action, on {states} random states |",
            "",
            "## Observation",
            "",
            *table(("entry", "quantity", "unit"), ((i, *entry) for i, entry in enumerate(seen))),
            "",
            "## Design",
            "",
            "Factors of the lengths of the body as it is drawn; the input `design` has those of the body it drives.",
            "",
            *table(
                ("entry", "segment", "factor", "range"),
                ((i, *row[:2], f"{row[2][0]:g} - {row[2][1]:g}") for i, row in enumerate(zip(names, design, low_high))),
            ),
            "",
            f"`{path.stem}-body.xml` is the body for MuJoCo, `{path.stem}-lengths.csv` its lengths in metres.",
            "",
            "## Action",
            "",
            "Each entry lies in [-1, 1].",
            "",
            *table(("entry", "joint", "at -1", "at 1", "unit"), ((i, *row) for i, row in enumerate(moved))),
            "",
            "## How it was made",
            "",
            *made(config),
            "",
        ]
    )


def made(config: dict[str, Any]) -> list[str]:
    """The origin of the run, from its ``config.json``."""
    versions = ", ".join(f"{name} {version}" for name, version in config.get("versions", {}).items())
    settings = config["settings"]
    return [
        f"A run of `coim run {config['environment']}` (preset {settings.get('preset', 'paper')}, seed "
        f"{settings['seed']}), begun {config.get('started', 'at an unknown time')}, revision "
        f"{config.get('revision') or 'unknown'}.",
        f"Versions: {versions or 'unknown'}. Written by `coim export`.",
    ]


def table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """Lines of a table in Markdown.

    Example:
        >>> table(("entry", "unit"), [(0, "m")])
        ['| entry | unit |', '|---|---|', '| 0 | m |']
    """
    lines = [heads, *rows]
    shown = [f"| {' | '.join(map(str, line))} |" for line in lines]
    return [shown[0], f"|{'---|' * len(heads)}", *shown[1:]]
