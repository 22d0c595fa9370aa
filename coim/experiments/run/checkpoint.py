"""Checkpoints of a run: written aside, synced, checksummed, renamed; the last two are kept.

``checkpoint/`` in a run's folder holds ``replay.bin``, to which the rows of each episode are appended, and for each
checkpoint a folder of `torchrl.checkpoint` with everything else (`coim.checkpoints`). TorchRL gives the format, the
adapters and the rotation; the checksums, the syncing and the replay that is not written again each time are ours.

References:
    TorchRL: `torchrl.checkpoint <https://docs.pytorch.org/rl>`_.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor
from torchrl.checkpoint import Checkpoint, CheckpointRotation, GlobalRNGState

from coim.checkpoints import (
    CHECKSUMS,
    FORMAT,
    PREFIX,
    Held,
    checksums,
    files_complaint,
    newest_whole,
    read_notes,
    state_parts,
)
from coim.experiments.run.atomic_write import ASIDE, sync, telling_full_disk
from coim.experiments.run.best_policies import BestPolicies
from coim.experiments.run.followed import Followed
from coim.experiments.run.replay_file import ReplayFile

KEPT = 2


class Checkpoints:
    """Saves an algorithm between two of its events, and lets another one go on from there.

    Args:
        folder: of the run.
        algorithm: whose episodes have ``episode_steps`` rows, and whose Replay_Pop holds all of them.
        best: the best policies of the algorithm so far.

    Note:
        Replay_Ind (the last rows of Replay_Pop) and Replay_s0 (the first of each episode) are not written: they are
        read out of Replay_Pop again. Replay_Art is written.
    """

    def __init__(self, folder: Path, algorithm: Followed, best: BestPolicies) -> None:
        self.folder, self.algorithm, self.best = folder / "checkpoint", algorithm, best
        self._replay = ReplayFile(self.folder / "replay.bin")
        self._step = 0

    def save(self, notes: Mapping[str, Any]) -> None:
        """Write a checkpoint; until it is complete, the one before it is the newest.

        Args:
            notes: plain JSON that goes with it.

        Raises:
            OSError: if it cannot be written: a full disk, a folder that has become read-only.
        """
        state, rows = without_replay(self.algorithm.state_dict())
        aside, path = self.folder / ASIDE.format(PREFIX), self.folder / f"{PREFIX}-{self._step + 1:012d}"
        try:
            with telling_full_disk(path):
                self.folder.mkdir(parents=True, exist_ok=True)
                self._replay.append({key: value[self._replay.num_rows :] for key, value in rows.items()})
                about = {"format": FORMAT, "replay": self._replay.description(), **notes}
                parts({"algorithm": Held(state), "best": self.best}, about).save(aside)
                seal(aside)
                os.replace(aside, path)
                sync(self.folder)
        except (OSError, RuntimeError) as error:
            last = f"the last one, number {self._step}, is good" if self._step else "there is none yet"
            shutil.rmtree(aside, ignore_errors=True)
            reason = str(error).splitlines()[0]
            raise OSError(f"the checkpoint could not be written ({reason}); training stops, {last}") from error
        self._step += 1
        CheckpointRotation(self.folder, keep_last=KEPT, prefix=PREFIX).prune()

    def load(self) -> dict[str, Any] | None:
        """Let the algorithm go on from the newest checkpoint that is whole.

        Returns:
            The notes that were saved with it; None if none was ever completed.

        Raises:
            ValueError: if there are checkpoints and none is whole, or it is one of another version or other sizes.
        """
        for path in self.folder.glob(".*/"):
            shutil.rmtree(path, ignore_errors=True)  # what a process that was killed had not finished
        newest, damaged = newest_whole(self.folder, self._complaint)
        if newest is None:
            return None
        if damaged:  # those of an earlier time are of no use any more, and would be in the way
            for old in self.folder.glob("damaged-*/"):
                shutil.rmtree(old, ignore_errors=True)
        for worse, why in damaged.items():
            os.replace(worse, worse.with_name(f"damaged-{worse.name}"))
            print(f"warning: {worse} is damaged ({why}); going on from {newest.name}", file=sys.stderr)
        return self._read(newest)

    def _complaint(self, path: Path) -> str | None:
        """What is wrong with a checkpoint or its part of the replay, or None."""
        if complaint := files_complaint(path):
            return complaint
        try:
            return self._replay.complaint(read_notes(path)["replay"])
        except (OSError, KeyError) as error:
            return f"{type(error).__name__}: {error}"

    def _read(self, path: Path) -> dict[str, Any]:
        notes, held = read_notes(path), {"algorithm": Held(), "best": Held()}
        # Each part moves what it takes to where it lives, which may not be where it lived: a GPU that is not here.
        parts(held, {}).load(path, map_location="cpu")
        rows = self._replay.read(notes["replay"])
        steps = self.algorithm.env.episode_steps
        self.algorithm.load_state_dict(with_replay(held["algorithm"].state, rows, steps))
        self.best.load_state_dict(held["best"].state)
        self._step = int(path.name.removeprefix(f"{PREFIX}-"))
        return notes


def parts(states: Mapping[str, Any], notes: dict[str, Any]) -> Checkpoint:
    """What a checkpoint consists of: states, and the generators that everybody shares."""
    return state_parts({**states, "random": SharedRandom()}, notes)


class SharedRandom(GlobalRNGState):
    """Generators that everybody in this process shares. Those of devices that it does not use are not read."""

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        own = self.state_dict()
        known = {name: state for name, state in state_dict.items() if name in own}
        if "torch_cuda" in known:  # a list, a state for each GPU
            known["torch_cuda"] = known["torch_cuda"][: len(own["torch_cuda"])]
        super().load_state_dict(known)


def without_replay(state: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Take out of a state what `with_replay` puts back in; returns the rest, and the rows of Replay_Pop."""
    buffers = dict(state["buffers"])
    rows = buffers["pop"]["rows"]
    for name in ("pop", "ind", "s0"):
        count = len(next(iter(buffers[name]["rows"].values()), ()))
        buffers[name] = {**buffers[name], "rows": count}
    # Copied, or torch.save would write the whole capacity that they are views of.
    art = {key: value.clone() for key, value in buffers["art"]["rows"].items()}
    buffers["art"] = {**buffers["art"], "rows": art}
    return {**state, "buffers": buffers}, rows


def with_replay(state: dict[str, Any], rows: Mapping[str, Tensor], episode_steps: int) -> dict[str, Any]:
    """Fill the buffers of a state with rows of Replay_Pop: all, those of the last body, the first of each episode."""
    chosen = {
        "pop": lambda rows, count: rows[:count],
        "ind": lambda rows, count: rows[len(rows) - count :],
        "s0": lambda rows, count: rows[::episode_steps][:count],
    }
    buffers = dict(state["buffers"])
    for name, choose in chosen.items():
        count = buffers[name]["rows"]
        filled = {key: choose(value, count) for key, value in rows.items()} if count else {}
        buffers[name] = {**buffers[name], "rows": filled}
    return {**state, "buffers": buffers}


def seal(folder: Path) -> None:
    """Write the checksums of all files of a folder beside them, and be sure that all is on the disk."""
    (folder / CHECKSUMS).write_text(json.dumps(checksums(folder), indent=2))
    for path in [*folder.rglob("*"), folder]:
        sync(path)
