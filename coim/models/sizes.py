"""The sizes of all networks of a run, in one place, so that training and loading build the same networks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal, Self

from torchrl.envs import EnvBase

from .ensemble import GaussianEnsemble
from .policy import Policy, make_policy
from .qvalue import QValue, make_qvalue


@dataclass(frozen=True, kw_only=True)
class NetworkSizes:
    """Builds the networks of a run.

    Attributes:
        num_runs: K; the networks of a single run have no run axis.
        num_cells: hidden units of the policy and of each critic.
        num_critics: N.
        model_cells: hidden units of each member of the ensemble.
        num_members: members of the ensemble.
        predict: what the ensemble predicts, see `GaussianEnsemble`.

    Example:
        >>> from coim import HopperMorph
        >>> sizes = NetworkSizes(
        ...     num_runs=1, num_cells=(8,), num_critics=2, model_cells=(8,), num_members=3, predict="delta"
        ... )
        >>> sizes.ensemble(HopperMorph(seed=0)).num_members
        3
    """

    num_runs: int
    num_cells: tuple[int, ...]
    num_critics: int
    model_cells: tuple[int, ...]
    num_members: int
    predict: Literal["delta", "next"]

    @classmethod
    def among(cls, values: Mapping[str, Any]) -> Self:
        """Take the sizes from a mapping that may have other settings too; lists, as in JSON, become tuples.

        Raises:
            KeyError: if a size is missing.
        """
        found: dict[str, Any] = {field.name: values[field.name] for field in fields(cls)}
        found |= {name: tuple(value) for name, value in found.items() if isinstance(value, list)}
        return cls(**found)

    @property
    def stacked(self) -> int | None:
        """K, or None if the networks have no run axis."""
        return self.num_runs if self.num_runs > 1 else None

    def policy(self, env: EnvBase) -> Policy:
        """Make a policy for an environment, with fresh weights."""
        return make_policy(env, num_cells=self.num_cells, num_runs=self.stacked)

    def qvalue(self, env: EnvBase) -> QValue:
        """Make critics for an environment, with fresh weights."""
        return make_qvalue(env, num_critics=self.num_critics, num_cells=self.num_cells, num_runs=self.stacked)

    def ensemble(self, env: EnvBase) -> GaussianEnsemble:
        """Make an ensemble for an environment, with fresh weights."""
        return GaussianEnsemble.for_env(
            env,
            num_members=self.num_members,
            num_cells=self.model_cells,
            predict=self.predict,
            num_runs=self.stacked,
        )
