"""The transitions of a run as a Minari dataset, for offline reinforcement learning.

Shapes: N rows, K runs, T steps of an episode, S observation, D design.

References:
    Younis et al.: Minari, https://minari.farama.org.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from coim.checkpoints import files_complaint, newest_whole, read_notes
from coim.envs.gymnasium_env import made_by_name
from coim.experiments.export.actor import needed
from coim.experiments.run.bodies import opened
from coim.experiments.run.replay_file import ReplayFile


def write_dataset(folder: Path, name: str, *, run: int | None, body: str | None) -> Any:
    """Write all episodes that a run has learnt from, of its newest whole checkpoint.

    Observations end with the design, as those of :class:`~coim.envs.gymnasium_env.GymnasiumEnv` do. An episode ends at
    its time limit, or where its simulation broke.

    Args:
        folder: of the run; nothing in it is changed.
        name: of the dataset, such as ``coim/hopper/first-v0``.
        run: one of K runs; None takes the episodes of all, one run after the other.
        body: class of the body as module:Class, if it is none of ours.

    Returns:
        Minari's dataset, in the folder that its environment variable ``MINARI_DATASETS_PATH`` names.

    Raises:
        ValueError: if there is no such run or no checkpoint, a dataset of this name is there already, or a package is
            not installed.
    """
    minari = needed("h5py", "minari", otherwise="")
    try:
        minari.dataset.minari_dataset.parse_dataset_id(name)  # refuses it before a folder of that name is made
    except TypeError as error:
        raise ValueError(f"{name!r} has no version; take a name such as coim/hopper/first-v0") from error
    loaded = opened(folder, body, run=run)
    rows = replay_of(folder)
    runs = range(rows["action"].shape[1]) if run is None else [run]
    env = made_by_name(type(loaded.bodies), task=loaded.settings["task"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # author, e-mail and web page are for who publishes it
        return minari.create_dataset_from_buffers(
            dataset_id=name,
            buffer=[minari.data_collector.EpisodeBuffer(**episode) for k in runs for episode in episodes(rows, k)],
            env=env.spec,
            action_space=env.action_space,
            observation_space=env.observation_space,
            algorithm_name="coim",
            description=f"Training episodes of {folder.name}: the design stands behind the state in each observation.",
        )


def replay_of(folder: Path) -> dict[str, Tensor]:
    """Rows of Replay_Pop in the newest checkpoint that is whole, ``[N, K, ...]`` each.

    Raises:
        ValueError: if there is none.
    """
    rows = ReplayFile(folder / "checkpoint" / "replay.bin")
    newest, _ = newest_whole(
        folder / "checkpoint", lambda path: files_complaint(path) or rows.complaint(read_notes(path)["replay"])
    )
    if newest is None:
        raise ValueError(f"{folder} has no checkpoint yet, or has been archived without its rows")
    return rows.peek(read_notes(newest)["replay"])


def episodes(rows: Mapping[str, Tensor], run: int) -> Iterator[dict[str, Any]]:
    """Episodes of one run in the order in which they were, as Minari takes them: one more observation than actions."""
    own = {name: values[:, run].numpy() for name, values in rows.items()}
    ends = np.flatnonzero(own["next.done"].ravel()) + 1
    for start, stop in zip([0, *ends[:-1]], ends):
        part = {name: values[start:stop] for name, values in own.items()}
        seen = np.concatenate([part["observation"], part["next.observation"][-1:]])
        designs = np.concatenate([part["design"], part["next.design"][-1:]])
        yield {
            "observations": np.concatenate([seen, designs], 1),
            "actions": part["action"],
            "rewards": part["next.reward"].ravel(),
            "terminations": part["next.terminated"].ravel(),
            "truncations": part["next.truncated"].ravel() & ~part["next.terminated"].ravel(),
        }
