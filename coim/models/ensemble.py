"""The probabilistic dynamics ensemble: a Gaussian over the next observation from each member, and TS1 sampling.

Shapes: ``B`` batch, ``K`` runs, ``E`` members, ``S`` state, ``A`` action, ``D`` design, ``R`` rows,
``F`` input features.

References:
    Chua et al. 2018, Deep Reinforcement Learning in a Handful of Trials (arXiv:1805.12114), [3] of the paper: the
    ensemble, its swish units, the initial bounds of its log-variance, TS1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn.functional import softplus
from torchrl.envs import EnvBase

from coim.angles import wrap_angle
from coim.calling import called_as

from .bodies import body_of, design_bounds, observed
from .normaliser import RunningNormaliser
from .stacked import StackedMLP

# Range of the log-variance of the standardised target: Chua et al.'s initial bounds, kept fixed.  Standardised targets
# have variance 1, which is inside.  exp(-10) is a standard deviation of 0.7 % of their spread: without this bound, a
# deterministic simulator would drive the density to infinity.
LOG_VAR_RANGE = (-10.0, 0.5)


class GaussianEnsemble(TensorDictModuleBase):
    r"""``E`` members that each predict a Gaussian over the next observation (Sec. 4, Model Learning).

    Member i is :math:`\mathcal N(\mu_{\psi^i}(s, a, \xi), \Sigma_{\psi^i}(s, a, \xi))` with diagonal covariance, over
    the *standardised target*: the next observation or its change, centred and scaled by the running statistics that
    :meth:`update_statistics` keeps.  As a TensorDict module it reads ``observation``, ``action``, ``design`` and writes
    the parameters of that Gaussian, ``mean`` and ``log_var``, each ``[*B, (K,) E, S]``.  :meth:`moments` and
    :meth:`sample` are in raw units.

    Args:
        num_observations: ``S``.
        num_actions: ``A``.
        num_designs: ``D``.
        num_members: ``E``.
        num_cells: units of each hidden layer.
        predict: ``"delta"``, the change of the observation, or ``"next"``, the next observation itself (Eq. 6 as
            printed).
        angle_indices: entries of the observation that are angles in (-pi, pi] rad.  Their changes and their predictions
            are wrapped.
        min_design_std: lower bound of the standard deviation by which design entries are scaled, ``[D]``.
        num_runs: ``K`` independent ensembles in one; the last batch dimension of their input is then the run axis.

    Raises:
        ValueError: if ``predict`` is unknown or an angle index is not one of the observation.

    Example:
        >>> ensemble = GaussianEnsemble(11, 3, 4, num_cells=(8, 8))
        >>> observation, action, design = torch.zeros(256, 11), torch.zeros(256, 3), torch.ones(256, 4)
        >>> ensemble.sample(observation, action, design).shape
        torch.Size([256, 11])
        >>> mean, var = ensemble.moments(observation, action, design)
        >>> mean.shape
        torch.Size([256, 3, 11])
    """

    def __init__(
        self,
        num_observations: int,
        num_actions: int,
        num_designs: int,
        *,
        num_members: int = 3,
        num_cells: Sequence[int] = (500, 500, 500),
        predict: Literal["delta", "next"] = "delta",
        angle_indices: Sequence[int] = (),
        min_design_std: Tensor | None = None,
        num_runs: int | None = None,
    ) -> None:
        super().__init__()
        if predict not in ("delta", "next"):
            raise ValueError(f"predict={predict!r} is unknown; choose 'delta' or 'next'")
        if not all(0 <= i < num_observations for i in angle_indices):
            raise ValueError(f"angle indices {list(angle_indices)} must lie in 0 .. {num_observations - 1}")
        self.in_keys, self.out_keys = ["observation", "action", "design"], ["mean", "log_var"]
        self.predict = predict
        self.num_members, self.angle_indices = num_members, tuple(angle_indices)
        num_inputs = num_observations + num_actions + num_designs
        self.network = StackedMLP(
            num_inputs,
            2 * num_observations,
            num_cells,
            num_runs=num_runs,
            num_copies=num_members,
            activation=nn.SiLU,
        )
        min_std = torch.zeros(num_inputs)
        if min_design_std is not None:
            min_std[-num_designs:] = min_design_std
        self.inputs = RunningNormaliser(num_inputs, num_runs=num_runs, min_std=min_std)
        self.targets = RunningNormaliser(num_observations, num_runs=num_runs)
        is_angle = torch.zeros(num_observations, dtype=torch.bool)
        is_angle[list(angle_indices)] = True
        self.register_buffer("is_angle", is_angle, persistent=False)

    @classmethod
    def for_env(
        cls,
        env: EnvBase,
        *,
        num_members: int = 3,
        num_cells: Sequence[int] = (500, 500, 500),
        predict: Literal["delta", "next"] = "delta",
        num_runs: int | None = None,
    ) -> GaussianEnsemble:
        """Build an ensemble that fits an environment (Sec. 6.1: three members, three hidden layers of 500 units).

        Design entries are divided by at least the standard deviation of a uniform draw within their bounds. After one
        design, or two similar ones, the running deviation is near 0, and any other design would become a huge input.
        Weights are drawn on the CPU, and then moved to the device and dtype of the observations.

        Args:
            env: any environment with ``observation_spec``, ``action_spec`` and bounds of the design, in the spec of its
                observation or as ``design_spec``. If entries of the observation are angles in (-pi, pi] rad, its body
                has ``angle_indices``.
            num_members: ``E``.
            num_cells: units of each hidden layer.
            predict: ``"delta"`` or ``"next"``.
            num_runs: ``K``, or None for a single run.

        Raises:
            ValueError: if a transform changes observations that contain angles, there is no ``observation`` or no
                design, or the workers of ``env`` differ.
        """
        seen = observed(env)
        body, rewritten = body_of(env)
        angle_indices = getattr(body, "angle_indices", ())
        if rewritten and angle_indices:
            raise ValueError(
                f"entries {list(angle_indices)} of the observation are angles, and a transform rewrites them; model "
                "the environment without its transforms, `env.base_env`"
            )
        low, high, bounded = design_bounds(env)
        with torch.device("cpu"):
            ensemble = cls(
                seen.shape[-1],
                env.action_spec.shape[-1],
                len(low),
                num_members=num_members,
                num_cells=num_cells,
                predict=predict,
                angle_indices=angle_indices,
                min_design_std=((high - low) / math.sqrt(12)).where(bounded, 0.0),
                num_runs=num_runs,
            )
        return ensemble.to(seen.device, seen.dtype)

    @property
    def num_runs(self) -> int | None:
        """``K``, or None for a single run."""
        return self.network.num_runs

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``mean`` and ``log_var`` of the standardised target, ``[*B, (K,) E, S]``."""
        mean, log_var = self._predict(*(tensordict[key] for key in self.in_keys))
        return tensordict.set(self.out_keys[0], mean).set(self.out_keys[1], log_var)

    def update_statistics(self, rows: TensorDictBase) -> None:
        """Merge rows of Replay_Pop into the running statistics of inputs and targets.

        Args:
            rows: ``[*B, (K)]``, each row only once, with ``observation``, ``action``, ``design`` and
                ``("next", "observation")``.
        """
        inputs = [rows[key] for key in self.in_keys]
        self.inputs.update(torch.cat(inputs, -1))
        self.targets.update(self._target(inputs[0], rows["next", self.in_keys[0]]))

    def standardised_target(self, observation: Tensor, next_observation: Tensor) -> Tensor:
        """Return the target of the members: the (change of the) next observation, standardised, ``[*B, (K,) S]``."""
        return self.targets(self._target(observation, next_observation))

    def moments(self, observation: Tensor, action: Tensor, design: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and variance of the next observation for each member, in raw units.

        Args:
            observation: ``[*B, (K,) S]``.
            action: ``[*B, (K,) A]``.
            design: ``[*B, (K,) D]``.

        Returns:
            Both ``[*B, (K,) E, S]``.
        """
        mean, log_var = self._predict(observation, action, design)
        scale = self.targets.std.to(mean.dtype).unsqueeze(-2)
        mean = mean * scale + self.targets.mean.to(mean.dtype).unsqueeze(-2)
        return self._next(observation.unsqueeze(-2), mean), log_var.exp() * scale.square()

    def sample(
        self,
        observation: Tensor,
        action: Tensor,
        design: Tensor,
        *,
        members: Tensor | None = None,
        noise: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Draw the next observation, h(s, a, xi) of Sec. 4: TS1, one member drawn uniformly for each transition.

        Args:
            observation: ``[*B, (K,) S]``.
            action: ``[*B, (K,) A]``.
            design: ``[*B, (K,) D]``.
            members: index of the member of each transition, ``[*B, (K)]``; drawn if None.
            noise: standard normal, ``[*B, (K,) S]``; drawn if None.  Zeros give the mean of the member.
            generator: source of both draws, on any device; torch's global one if None.

        Returns:
            ``[*B, (K,) S]``.

        Raises:
            IndexError: if a member index is not in ``0 .. E - 1``.
        """
        batch, device = observation.shape[:-1], observation.device
        source = device if generator is None else generator.device
        if members is None:
            members = self._draw_members(batch, device, generator)
        elif not ((members >= 0) & (members < self.num_members)).all():
            raise IndexError(f"members must lie in 0 .. {self.num_members - 1}, got {members.unique().tolist()}")
        if noise is None:
            noise = torch.randn(observation.shape, generator=generator, device=source, dtype=observation.dtype)
            noise = noise.to(device)
        inputs = self._inputs(observation, action, design)
        mean, log_var = self._grouped(inputs, members).chunk(2, -1)
        target = mean + (self._bounded(log_var) / 2).exp() * noise
        target = target * self.targets.std.to(target.dtype) + self.targets.mean.to(target.dtype)
        return self._next(observation, target)

    def means(
        self, *asked: tuple[Tensor, Tensor, Tensor], generator: torch.Generator | None = None
    ) -> tuple[Tensor, ...]:
        """Return the mean next observations of several queries: one member per transition, the same for all queries.

        Args:
            asked: queries (observation ``[*B, (K,) S]``, action ``[*B, (K,) A]``, design ``[*B, (K,) D]``) of one batch
                shape.
            generator: draws the members, on any device; torch's global one if None.

        Returns:
            ``[*B, (K,) S]`` for each query; equal queries have equal results, to the last bit.
        """
        first = asked[0][0]
        members = self._draw_members(first.shape[:-1], first.device, generator)
        return tuple(self.sample(*one, members=members, noise=torch.zeros_like(one[0])) for one in asked)

    def disagreement(self, observation: Tensor, action: Tensor, design: Tensor) -> Tensor:
        """How far the members' means lie apart, in variances of the target, averaged over entries: ``[*B, (K)]``.

        Args:
            observation: ``[*B, (K,) S]``.
            action: ``[*B, (K,) A]``.
            design: ``[*B, (K,) D]``.
        """
        means, _ = self._predict(observation, action, design)
        if self.predict == "next":  # two angles beside the cut at pi are near; of changes none is that large
            std = self.targets.std.to(means.dtype).unsqueeze(-2)
            means = self.wrapped((means - means[..., :1, :]) * std) / std
        return means.var(-2, correction=0).mean(-1)

    def _draw_members(self, batch: torch.Size, device: torch.device, generator: torch.Generator | None) -> Tensor:
        """Draw a member for each transition, uniformly."""
        source = device if generator is None else generator.device
        return torch.randint(self.num_members, batch, generator=generator, device=source).to(device)

    def _inputs(self, observation: Tensor, action: Tensor, design: Tensor) -> Tensor:
        """What the network reads, ``[*B, (K,) F]``; refuse inputs of another body."""
        found = [part.shape[-1] for part in (observation, action, design)]
        if sum(found) != self.network.in_features or found[0] != len(self.is_angle):
            raise ValueError(
                f"observation, action and design have {found} numbers, this model reads {self.network.in_features}, of "
                f"which {len(self.is_angle)} are observed; make it for this body by GaussianEnsemble.for_env"
            )
        return self.inputs(torch.cat([observation, action, design], -1))

    def _predict(self, observation: Tensor, action: Tensor, design: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_var = self.network(self._inputs(observation, action, design)).chunk(2, -1)
        return mean, self._bounded(log_var)

    def _bounded(self, log_var: Tensor) -> Tensor:
        low, high = LOG_VAR_RANGE
        log_var = high - softplus(high - log_var)
        return low + softplus(log_var - low)

    def _target(self, observation: Tensor, next_observation: Tensor) -> Tensor:
        return self.wrapped(next_observation - observation) if self.predict == "delta" else next_observation

    def _next(self, observation: Tensor, target: Tensor) -> Tensor:
        return self.wrapped(observation + target if self.predict == "delta" else target)

    def wrapped(self, x: Tensor) -> Tensor:
        """Wrap the angles in observations, or in differences of observations, to (-pi, pi], ``[*B, S]``."""
        return torch.where(self.is_angle, wrap_angle(x), x) if self.angle_indices else x

    def _grouped(self, inputs: Tensor, members: Tensor) -> Tensor:
        """Evaluate each member on its own rows only: ``[*B, (K,) F], [*B, (K)] -> [*B, (K,) 2 S]``."""
        if not called_as(self.network, StackedMLP):  # a hook or another forward may do more than the layers
            every = self.network(inputs)
            return every.take_along_dim(members[..., None, None], -2).squeeze(-2)
        runs = self.num_runs or 1
        rows = inputs.reshape(-1, runs, inputs.shape[-1])
        groups = members.reshape(-1, runs) + self.num_members * torch.arange(runs, device=members.device)
        if self.network.serves_bare(inputs, groups.numel() // (self.num_members * runs)):
            out = self._by_group(rows.flatten(0, 1), groups.flatten())
        else:  # chunks of about 3,000 rows keep the activations in a CPU's cache
            size = max(1, (3_000 if inputs.device.type == "cpu" else 100_000) // runs)
            chunks = zip(rows.split(size), groups.split(size))
            out = torch.cat([self._grouped_chunk(x.flatten(0, 1), g.flatten()) for x, g in chunks])
        return out.reshape(*inputs.shape[:-1], self.network.out_features)

    def _by_group(self, rows: Tensor, group: Tensor) -> Tensor:
        """Evaluate group after group of ``[R, F]``, without gradients and without padding."""
        counts = torch.bincount(group, minlength=self.num_members * (self.num_runs or 1))
        out = rows.new_empty(len(rows), self.network.out_features)
        for copy, own in enumerate(group.argsort(stable=True).split(counts.tolist())):
            if len(own):
                out[own] = self.network.forward_copy(copy, rows[own])
        return out

    def _grouped_chunk(self, rows: Tensor, group: Tensor) -> Tensor:
        """Sort ``[R, F]`` into zero-padded groups of one length, evaluate them, and restore the order of the rows."""
        num_groups = self.num_members * (self.num_runs or 1)
        counts = torch.bincount(group, minlength=num_groups)
        longest, starts = int(counts.max()), counts.cumsum(0) - counts
        order = group.argsort(stable=True)
        place = torch.empty_like(group)
        place[order] = torch.arange(len(group), device=group.device) - starts[group[order]]
        place += group * longest
        padded = rows.new_zeros(num_groups * longest, rows.shape[-1]).index_copy(0, place, rows)
        out = self.network.forward_stacked(padded.unflatten(0, (num_groups, longest)))
        return out.flatten(0, 1)[place]
