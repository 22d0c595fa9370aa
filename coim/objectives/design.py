r"""Fitness of candidate designs, Eq. 5.

Shapes: ``P`` particles, ``D`` design, ``n`` start states, ``N`` critics.

References:
    Co-Imagination of Behaviour & Morphology of Agents, Eq. 5 and Algorithm 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import LossModule

from coim.calling import called_as

from .functional import design_value
from .moving import lent, move
from .runs import check_num_runs

# Evaluated at a time: on a CPU what keeps the activations in the cache of a core, elsewhere what fits into memory.
CHUNK_ROWS = {"cpu": 2_000}
MANY_ROWS = 100_000


class Transferring(Protocol):
    """Bodies that know how a state of one looks under another, such as :class:`coim.MorphEnv`."""

    def transfer(self, observation: Tensor, design: Tensor, new_design: Tensor) -> Tensor:
        """Put states ``[*B, S]`` of bodies ``[*B, D]`` under others ``[*B, D]``, the batches broadcast: ``[*B, S]``."""


class DesignValue(LossModule):
    r"""How much return the critics expect of a design: :math:`\frac 1 n \sum_s \min_n Q_n(s, \pi(s, \xi), \xi)`.

    The action is the deterministic one; the design of the start states is replaced by the query.  It is called with a
    tensor, ``[P, D] -> [P]``, or with a TensorDict that has ``design``, and then returns one with ``design_value``.

    Gradients flow to the designs if these require them, never to the weights.

    Args:
        policy: any TensorDict module that writes the action; it is asked for its deterministic one.
        qvalue: any TensorDict module that writes ``[*B, N]`` values.
        start_states: ``[n]`` rows of Replay_s0 with whatever the networks read besides design and action; copied, so
            that it does not matter what becomes of them.
        chunk_size: particles evaluated at a time.  None: as many as make 2,000 rows on a CPU, which keeps its cache,
            and 100,000 elsewhere.
        precision: ``"bfloat16"`` evaluates the networks in bfloat16; their weights stay as they are.  On trained
            networks values are off by less than 1 % each, and the design that a swarm chooses loses less than 0.1 %.

    Raises:
        ValueError: if there are no start states, they are not finite, ``precision`` is unknown, or a network is a
            fleet.  When called: if designs are not ``[P, D]`` or not finite.

    Note:
        Start states are the paper's. Rows of Replay_Pop in their place average over the states that were visited.

        For a fleet, cut out one run with :func:`~coim.models.select_run` first: designs are chosen run by run.

        The networks of :mod:`coim.models` are asked on bare tensors, without the TensorDict and the log-density that
        nobody reads: a fifth less time.

    Example:
        >>> from coim.models import Policy, PolicyNetwork, QValue, QValueNetwork
        >>> policy, qvalue = Policy(PolicyNetwork(11, 4, 3)), QValue(QValueNetwork(11, 3, 4))
        >>> fitness = DesignValue(policy, qvalue, TensorDict({"observation": torch.zeros(36, 11)}, [36]))
        >>> fitness(torch.ones(700, 4)).shape
        torch.Size([700])
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` changes.

        Attributes:
            observation: what the networks read of a state, and what is matched.
            design: where the networks read the query.
            state_action_value: written by the critics.
        """

        observation: NestedKey = "observation"
        design: NestedKey = "design"
        state_action_value: NestedKey = "state_action_value"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    out_keys = ["design_value"]  # noqa: RUF012, TorchRL's convention

    policy: TensorDictModule
    policy_params: TensorDictParams
    target_policy_params: TensorDictParams
    qvalue: TensorDictModule
    qvalue_params: TensorDictParams
    target_qvalue_params: TensorDictParams

    def __init__(
        self,
        policy: TensorDictModule,
        qvalue: TensorDictModule,
        start_states: TensorDictBase,
        *,
        chunk_size: int | None = None,
        precision: Literal["float32", "bfloat16"] = "float32",
        start_states_are: Literal["stored", "matched"] = "stored",
        env: Transferring | None = None,
    ) -> None:
        super().__init__()
        if start_states.batch_dims != 1 or not len(start_states):
            raise ValueError(
                f"start_states has batch size {list(start_states.batch_size)}; give [n] rows of Replay_s0, at least one"
            )
        if chunk_size is not None and chunk_size < 1:
            raise ValueError(f"chunk_size={chunk_size} must be at least 1, or None to fit the cache")
        if precision not in ("float32", "bfloat16"):
            raise ValueError(f"precision={precision!r} is unknown; choose 'float32' or 'bfloat16'")
        self._transfer = _transfer_of(env, start_states_are)
        check_num_runs(None, policy, qvalue)
        self.convert_to_functional(policy, "policy")
        self.convert_to_functional(qvalue, "qvalue")
        read = [*policy.in_keys, *qvalue.in_keys]
        if self._transfer is not None:  # reads them whatever the networks do
            read += [self.tensor_keys.observation, self.tensor_keys.design]
        self.start_states = start_states.select(*read, strict=False).detach().clone()
        self.chunk_size, self.precision = chunk_size, precision
        broken = [key for key, value in self.start_states.items(True, True) if not value.isfinite().all()]
        if broken:
            raise ValueError(f"start_states has NaN or infinite entries in {broken}; drop these rows")

    @property
    def in_keys(self) -> list[NestedKey]:
        """The design."""
        return [self.tensor_keys.design]

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        """There is no value estimator."""

    def _apply(self, fn: Callable[[Tensor], Tensor]) -> DesignValue:
        """Move to a device or dtype; networks and start states come along."""
        with move(fn, (self.policy, self.policy_params), (self.qvalue, self.qvalue_params)):
            super()._apply(fn)
        self.start_states = self.start_states.apply(fn, device=None)
        return self

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Evaluate designs.

        Args:
            tensordict: has ``design``, ``[P, D]``; left as it is.

        Returns:
            A TensorDict with ``design_value``, ``[P]``.
        """
        designs = tensordict[self.tensor_keys.design]
        self._check(designs)
        weights, states = (self.policy_params.data, self.qvalue_params.data), self.start_states
        if self.precision == "bfloat16":
            weights, states = tuple(w.bfloat16() for w in weights), states.bfloat16()
        evaluate = self._bare_chunk if self._networks_are_bare() else self._chunk
        with (
            torch.set_grad_enabled(torch.is_grad_enabled() and designs.requires_grad),
            lent(weights[0], self.policy),
            lent(weights[1], self.qvalue),
        ):
            q = [evaluate(states, chunk).to(designs.dtype) for chunk in designs.chunk(self._num_chunks(designs))]
        value = torch.cat([design_value(part) for part in q])
        return TensorDict({"design_value": value}, value.shape)

    def _networks_are_bare(self) -> bool:
        """Whether both can be asked on bare tensors, as a `coim.models.Policy` and `coim.models.QValue` that were left
        as they were made.
        """
        keys = (self.tensor_keys.observation, self.tensor_keys.design, self.tensor_keys.state_action_value)
        methods = hasattr(self.policy, "deterministic_action") and hasattr(self.qvalue, "values")
        if keys != ("observation", "design", "state_action_value") or not methods:
            return False
        plain = called_as(self.policy, ProbabilisticActor) and called_as(self.qvalue, TensorDictModule)
        return plain and self.policy[-1].distribution_class is TanhNormal and not self.policy[-1].distribution_kwargs

    def _num_chunks(self, designs: Tensor) -> int:
        rows = CHUNK_ROWS.get(designs.device.type, MANY_ROWS)
        size = self.chunk_size or max(1, rows // len(self.start_states))
        return max(1, -(-len(designs) // size))

    def _chunk(self, states: TensorDictBase, designs: Tensor) -> Tensor:
        """Values ``[P, n, N]`` by any TensorDict modules."""
        rows = states.expand(len(designs), len(states))
        if self._transfer is not None:
            rows.set(self.tensor_keys.observation, self._observed(states, designs))
        rows.set(self.tensor_keys.design, self._query(states, designs))
        return self.qvalue(self.policy(rows))[self.tensor_keys.state_action_value]

    def _bare_chunk(self, states: TensorDictBase, designs: Tensor) -> Tensor:
        """Values ``[P, n, N]`` by networks that take bare tensors."""
        observation, design = self._observed(states, designs), self._query(states, designs)
        return self.qvalue.values(observation, self.policy.deterministic_action(observation, design), design)

    def _observed(self, states: TensorDictBase, designs: Tensor) -> Tensor:
        """Observations of all start states under each design, ``[P, n, S]``."""
        seen = states[self.tensor_keys.observation]
        if self._transfer is None:
            return seen.expand(len(designs), -1, -1)
        # From the states as they were stored: only what the networks read is rounded to their precision.
        stored, own = self.start_states[self.tensor_keys.observation], self.start_states[self.tensor_keys.design]
        return self._transfer(stored, own, designs.unsqueeze(1)).to(seen.dtype)

    def _query(self, states: TensorDictBase, designs: Tensor) -> Tensor:
        """The designs for all start states, ``[P, n, D]``, in the precision of these, which is that of the networks."""
        seen = states.get(self.tensor_keys.observation, designs)
        return designs.to(seen.dtype).unsqueeze(1).expand(-1, len(self.start_states), -1)

    def _check(self, designs: Tensor) -> None:
        size = self.start_states.get(self.tensor_keys.design, designs).shape[-1]
        if designs.dim() != 2 or designs.shape[-1] != size:
            raise ValueError(f"designs of shape {list(designs.shape)} must be [P, {size}]: one row for each candidate")
        if not designs.isfinite().all():
            bad = (~designs.isfinite().all(-1)).nonzero().flatten().tolist()
            raise ValueError(f"designs {bad} have NaN or infinite entries; project them with design_spec.project()")
        if self._transfer is not None and self.tensor_keys.design not in self.start_states.keys(True):
            raise ValueError(
                f"start states to be matched lack {self.tensor_keys.design!r}, the bodies that they were seen with; "
                "give rows of Replay_s0 or Replay_Pop as they are"
            )


def _transfer_of(env: Transferring | None, start_states_are: str) -> Callable[[Tensor, Tensor, Tensor], Tensor] | None:
    """What puts start states under the query: nothing, if they stay as they are stored."""
    if start_states_are not in ("stored", "matched"):
        raise ValueError(f"start_states_are={start_states_are!r} is unknown; choose 'stored' or 'matched'")
    if start_states_are == "stored":
        return None
    if env is None:
        raise ValueError("start states are matched by the bodies' transfer(); pass env, or leave the states 'stored'")
    if isinstance(env, TransformedEnv):
        raise TypeError("states are matched as the bodies themselves observe them; pass env.base_env")
    if not hasattr(env, "transfer"):
        raise TypeError(f"a {type(env).__name__} has no transfer() to match states with; pass a MorphEnv")
    return env.transfer
