"""The policy to which each design owes its best return, kept while the run goes on learning.

The figure of merit of a design is its best evaluation, and the individual learner has moved on when the design's last
episode is over. So the weights of the best so far are held, are a part of every checkpoint, and are written to
``policies/design-<number>.pt`` when the design is done: 0.35 MB for each run and design at the paper's sizes.

Shapes: K runs, D design.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from coim.events import DesignChosen, EpisodeDone, Event
from coim.experiments.run.atomic_write import write_whole
from coim.experiments.run.followed import Followed
from coim.run_folder import policy_path


class BestPolicies:
    """Holds, for each run, the policy of the best evaluation of the present design.

    Args:
        folder: of the run.
        algorithm: whose events are followed; nothing in it is changed.
    """

    def __init__(self, folder: Path, algorithm: Followed) -> None:
        self.folder, self.algorithm = folder, algorithm
        self._best: dict[str, Any] = {}
        self._start = self._next_start()

    def follow(self, event: Event) -> None:
        """Hear of an event before the algorithm goes on: hold what is best so far, write it when a design is done.

        Raises:
            OSError: if it cannot be written.
        """
        if isinstance(event, DesignChosen):
            self._best = {}
        elif isinstance(event, EpisodeDone):
            self._hold(event)
        elif self._best:
            path = policy_path(self.folder, event.index + 1)
            path.parent.mkdir(exist_ok=True)
            contents = io.BytesIO()
            torch.save(self._best, contents)
            write_whole(path, contents.getvalue())

    def state_dict(self) -> dict[str, Any]:
        """Return what is held of the present design; tensors are not copied."""
        return self._best

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on as the one that :meth:`state_dict` was read from, after the algorithm has loaded its own state."""
        self._best = dict(state_dict)
        self._start = self._next_start()

    def _hold(self, event: EpisodeDone) -> None:
        """Take over the rows of those runs whose evaluation was their best on this design, ``[K, ...]`` each."""
        policy = self.algorithm.individual.policy
        weights = policy.network.mlp.state_dict()
        if policy.num_runs is None:
            weights = {name: values.unsqueeze(0) for name, values in weights.items()}
        found = {
            "return": event.evaluation_return,
            "design": event.design,
            "start": self._start,
            "policy": weights,
        }
        better = torch.ones_like(event.evaluation_return, dtype=torch.bool)
        if self._best:
            better = event.evaluation_return > self._best["return"]
        self._best = _chosen(better.cpu(), found, self._best or found)
        self._start = self._next_start()

    def _next_start(self) -> Tensor:
        """What the next evaluation's start will be drawn from, ``[K, n]``."""
        return self.algorithm.evaluation_env.get_simulation_state()["generator"]


def _chosen(rows: Tensor, one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """The given rows of one nested state and the rest of another, copied, on the CPU."""
    chosen: dict[str, Any] = {}
    for name, values in one.items():
        if isinstance(values, Mapping):
            chosen[name] = _chosen(rows, values, other[name])
        else:
            mask = rows.view(-1, *[1] * (values.dim() - 1))
            chosen[name] = torch.where(mask, values.cpu(), other[name].cpu())
    return chosen
