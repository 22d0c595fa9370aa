"""Read checkpoints of a run from disk; `coim.experiments.run.checkpoint` writes them.

A run's ``checkpoint/`` holds a folder of `torchrl.checkpoint` for each of the last two checkpoints. TorchRL gives the
format and the adapters. The checksums beside them, which tell a damaged checkpoint, are ours.

References:
    TorchRL: `torchrl.checkpoint <https://docs.pytorch.org/rl>`_.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import Checkpoint, StateDictCheckpointAdapter

FORMAT = 2  # version of what a checkpoint contains; another one is refused
CHECKSUMS = "sha256.json"
PREFIX = "checkpoint"


class Held:
    """Hold a state that is read from a file, so that nothing is changed before all of it is read."""

    def __init__(self, state: Mapping[str, Any] | None = None) -> None:
        self.state = dict(state or {})

    def state_dict(self) -> dict[str, Any]:
        return self.state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.state = state


def newest_whole(folder: Path, complaint: Callable[[Path], str | None]) -> tuple[Path | None, dict[Path, str]]:
    """Find the newest checkpoint that nothing is wrong with, and change no file.

    Args:
        folder: a run's ``checkpoint/``.
        complaint: says what is wrong with a checkpoint, or None; see `files_complaint`.

    Returns:
        Its folder, and the newer ones with what is wrong with each. None if there was never a checkpoint.

    Raises:
        ValueError: if there are checkpoints and none is whole.
    """
    damaged: dict[Path, str] = {}
    for path in sorted(folder.glob(f"{PREFIX}-*"), reverse=True):
        wrong = complaint(path)
        if wrong is None:
            return path, damaged
        damaged[path] = wrong
    if damaged:
        raise ValueError("no checkpoint is whole: " + "; ".join(f"{path} ({why})" for path, why in damaged.items()))
    return None, damaged


def files_complaint(path: Path) -> str | None:
    """Say what is wrong with the files of a checkpoint; None if nothing is."""
    try:
        expected = json.loads((path / CHECKSUMS).read_text())
        actual = checksums(path)
        wrong = sorted(name for name in expected.keys() | actual.keys() if expected.get(name) != actual.get(name))
        return f"{', '.join(wrong)} not as written" if wrong else None
    except (OSError, ValueError) as error:
        return f"{type(error).__name__}: {error}"


def checksums(folder: Path) -> dict[str, str]:
    """SHA-256 of every file in a folder but the checksums themselves."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != CHECKSUMS)
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def read_notes(path: Path) -> dict[str, Any]:
    """Read the plain JSON that was saved with a checkpoint.

    Raises:
        ValueError: if it was written in another format than this version's.
    """
    notes: dict[str, Any] = {}
    Checkpoint(notes=notes).load(path)
    if notes["format"] != FORMAT:
        raise ValueError(
            f"{path} has format {notes['format']}, this version writes {FORMAT}; go on with the version in "
            "the run's config.json"
        )
    return notes


def state_parts(states: Mapping[str, Any], notes: dict[str, Any]) -> Checkpoint:
    """A checkpoint of some parts, each with ``state_dict`` and ``load_state_dict``, and of notes in plain JSON."""
    checkpoint = Checkpoint(notes=notes)
    for name, part in states.items():
        # One file each: a file for every tensor, TorchRL's default, costs a sync for every tensor.
        checkpoint.register(name, part, adapter=StateDictCheckpointAdapter("torch"))
    return checkpoint


def read_state(path: Path, part: str, *, device: torch.device | str | None = None) -> dict[str, Any]:
    """Read the state of one part of a checkpoint.

    Args:
        path: the checkpoint's folder.
        part: its name.
        device: where its tensors go; None puts them where they were.
    """
    held = Held()
    state_parts({part: held}, {}).load(path, components=[part], map_location=device)
    return held.state
