"""How much of a batch may be imagined: as much as the model has earned, run by run.

Shapes: ``N`` rows, ``K`` runs.

References:
    Co-Imagination of Behaviour and Morphology of Agents: Sec. 5 (a fifth of each batch is imagined), Sec. 6.4
    (imagination that destroys learning).

    Voelcker et al., *MAD-TD*, 2024 (arXiv:2410.08896): a twentieth of a batch is enough.

    Kidambi et al., *MOReL*, 2020 (arXiv:2005.05951): members that disagree tell what a model does not know.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from coim.models.ensemble import GaussianEnsemble
from coim.pairs import stand_ins

# Errors of single members on an episode that they have not learnt from, in variances of its one-step changes: that
# nothing changes scores 1. On the first episode of a new body nine in ten models that learn as they should have
# less than 0.7 (Hopper; half of them less than 0.4 to 0.5, and two thirds of the Half-Cheetah's less than 0.1), while
# weights that have learnt nothing have 1.0, and a model that is off by one standard deviation 0.95 or more
# (docs/results/README.md, "Imagined rows").
UNEARNED = 0.7  # and above: nothing
EARNED = 0.1  # and below: the whole share
LEAST_SHARE = 0.05  # of a batch, just below UNEARNED
# Rows on which the members disagree more than on all but one in twenty real rows are not learnt from. Of a sound model
# that is asked about random bodies these are 6 to 9 in 100; where they are most rows, it is asked about what it does
# not know at all.
AGREEING_QUANTILE = 0.95
AGREED = 0.5
QUANTILE_ROWS = 2_000  # real rows that the quantile is taken over


class Governor:
    """The share of imagined rows in a batch, from what is measured of the model.

    Two things are measured. The model's *error* on each training episode before it learns from it: of the newest body's
    first episode, which leaves one body out of all that was learnt from, and of the latest episode; the larger one
    counts. The members' *disagreement* on imagined rows, against its quantile on real ones: rows above it are replaced,
    and where that is most of them, nothing is imagined.

    Nothing is drawn here. A run whose share is nothing is left as it is.

    Args:
        ensemble: the model that imagines, of at least two members.

    Raises:
        ValueError: if the ensemble has one member, which cannot disagree with any.

    Example:
        >>> governor = Governor(GaussianEnsemble(11, 3, 4, num_cells=(8,)))
        >>> governor.shares(0.2)  # before anything was measured
        tensor([0.])
        >>> governor.observe(torch.tensor([0.3]), first=True)
        >>> governor.shares(0.2)
        tensor([0.1500])
    """

    def __init__(self, ensemble: GaussianEnsemble) -> None:
        if ensemble.num_members < 2:
            raise ValueError(
                "the ensemble has one member, and a governor asks how far members disagree; give two or more"
            )
        self.ensemble = ensemble
        runs = ensemble.num_runs or 1
        nothing = torch.full((runs,), torch.inf, dtype=torch.float32, device="cpu")
        self._state = {"first": nothing, "latest": nothing.clone(), "agreed": torch.ones_like(nothing)}

    def observe(self, error: Tensor, *, first: bool) -> None:
        """Take note of how well an episode was foreseen.

        Args:
            error: of `coim.DynamicsLearner.error`, before the model has learnt from these rows, ``[K]``.
            first: whether it is the first episode of a body.

        Raises:
            ValueError: if there is not one error for each run.
        """
        if error.shape != self._state["latest"].shape:
            raise ValueError(
                f"the errors have shape {list(error.shape)}, the ensemble {len(self._state['latest'])} runs; pass [K]"
            )
        for name in ("first", "latest") if first else ("latest",):
            self._state[name] = error.detach().float().cpu().clone()

    @torch.no_grad()
    def agreeing(self, imagined: TensorDictBase, real: TensorDictBase) -> TensorDictBase:
        """Replace the rows on which the members disagree by others of the same run.

        Args:
            imagined: ``[N]`` or ``[N, K]``.
            real: rows of Replay_Pop, ``[N]`` or ``[N, K]``; the first 2,000 of a run count.

        Returns:
            As many rows; a run none of whose rows agrees keeps them, and its share is 0.
        """
        limit = self._disagreement(real[:QUANTILE_ROWS]).quantile(AGREEING_QUANTILE, dim=0)
        agreeing = self._disagreement(imagined) <= limit
        self._state["agreed"] = agreeing.float().mean(0).reshape(-1).cpu()
        taken = stand_ins(agreeing | ~agreeing.any(0))
        return (
            imagined[taken] if taken.ndim == 1 else imagined[taken, torch.arange(taken.shape[1], device=taken.device)]
        )

    def earns(self) -> bool:
        """Whether a run may imagine at all, as far as errors tell; the members are asked when there are rows."""
        return bool((self._error() < UNEARNED).any())

    def shares(self, most: float) -> Tensor:
        """Share of a batch that is imagined, ``[K]`` on the CPU: 0, or from 0.05 up to ``most``."""
        error = self._error()
        least = min(LEAST_SHARE, most)
        earned = ((UNEARNED - error) / (UNEARNED - EARNED)).clamp(0, 1)
        allowed = (error < UNEARNED) & (self._state["agreed"] >= AGREED)  # an error that is NaN is not below
        return torch.where(allowed, least + (most - least) * earned.nan_to_num(), 0.0)

    def state_dict(self) -> dict[str, Tensor]:
        """Return what was measured last."""
        return dict(self._state)

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on from what was measured.

        Raises:
            ValueError: if it was measured of another number of runs; nothing is changed then.
        """
        for name, own in self._state.items():
            if state_dict[name].shape != own.shape:
                raise ValueError(
                    f"the state was measured of {len(state_dict[name])} run(s), the ensemble has {len(own)}; make it "
                    "with the number of runs that the state was saved with"
                )
        self._state = {name: state_dict[name].clone() for name in self._state}

    def _error(self) -> Tensor:
        return torch.maximum(self._state["first"], self._state["latest"])

    def _disagreement(self, rows: TensorDictBase) -> Tensor:
        return self.ensemble.disagreement(rows["observation"], rows["action"], rows["design"])
