"""Where Algorithm 1 stands between two of its events.

Shapes: K runs, D design.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Algorithm 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from coim.events import DesignChosen, DesignDone, Kind, Place


@dataclass
class Trial:
    """A body that is being tried.

    Attributes:
        kind: of the design.
        design: ``[K, D]``.
        predicted: Eq. 5 at this design when it was chosen, ``[K]`` on the CPU, or None.
        best: highest evaluation return so far, ``[K]`` on the CPU; -inf of a run that has none, such as one that has
            diverged before.
        next_episode: episodes that are over; with 0 the individual learner has not started yet.
    """

    kind: Kind
    design: Tensor
    predicted: Tensor | None
    best: Tensor
    next_episode: int = 0


@dataclass
class Position:
    """How far Algorithm 1 is.

    Attributes:
        index: of the design that is being tried, or that is chosen next; from 0.
        env_steps: training steps of one run so far.
        trial: the body that is being tried; None between two bodies.
        tried: designs whose episodes are over, in the order of building.
    """

    index: int = 0
    env_steps: int = 0
    trial: Trial | None = None
    tried: list[DesignDone] = field(default_factory=list)

    def begin(self, chosen: DesignChosen) -> Trial:
        """Start to try a body."""
        best = torch.full(chosen.design.shape[:1], -torch.inf, dtype=torch.float32, device="cpu")
        self.trial = Trial(chosen.kind, chosen.design.clone(), chosen.predicted, best)  # the event is the listener's
        return self.trial

    def end(self, trial: Trial, best_return: Tensor, diverged: Mapping[int, Place]) -> DesignDone:
        """Go on behind a body whose episodes are over."""
        done = DesignDone(self.index, trial.kind, trial.design.clone(), best_return.clone(), dict(diverged))
        self.index, self.trial = self.index + 1, None
        self.tried.append(replace(done, design=trial.design, best_return=best_return))
        return done

    def state_dict(self) -> dict[str, Any]:
        """Return numbers, strings, tensors and dicts of them; tensors are not copied."""
        return {
            "index": self.index,
            "env_steps": self.env_steps,
            "trial": None if self.trial is None else dict(vars(self.trial)),
            "tried": [dict(vars(done)) for done in self.tried],
        }

    def load_state_dict(self, state_dict: Mapping[str, Any], *, device: torch.device | None = None) -> None:
        """Stand where :meth:`state_dict` was read; nothing of it is shared.

        Args:
            state_dict: is left as it is. One that was saved before designs tried were kept has none.
            device: where the bodies are.
        """
        self.index, self.env_steps = state_dict["index"], state_dict["env_steps"]
        trial = state_dict["trial"]
        self.trial = None if trial is None else Trial(**_copied(trial, device))
        self.tried = [DesignDone(**_copied(done, device)) for done in state_dict.get("tried", ())]


def _copied(saved: Mapping[str, Any], device: torch.device | None) -> dict[str, Any]:
    """Tensors of one's own, the design on the bodies' device."""
    own: dict[str, Any] = {name: value.clone() if isinstance(value, Tensor) else value for name, value in saved.items()}
    return {**own, "design": own["design"].to(device)}
