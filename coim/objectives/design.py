r"""Fitness of candidate designs, Eq. 5.

Shapes: ``P`` particles, ``D`` design, ``n`` start states, ``N`` critics.

References:
    Co-Imagination of Behaviour & Morphology of Agents, Eq. 5 and Algorithm 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule

from .functional import design_value
from .runs import check_num_runs


class DesignValue(LossModule):
    r"""How much return the critics expect of a design: :math:`\frac 1 n \sum_s \min_n Q_n(s, \pi(s, \xi), \xi)`.

    The action is the deterministic one; the design of the start states is replaced by the query.  It is called with a
    tensor, ``[P, D] -> [P]``, or with a TensorDict that has ``design``, and then returns one with ``design_value``.

    Gradients flow to the designs if these require them, never to the weights.

    Args:
        policy: any TensorDict module that writes the action; it is asked for its deterministic one.
        qvalue: any TensorDict module that writes ``[*B, N]`` values.
        start_states: ``[n]`` rows of Replay_s0 with whatever the networks read besides design and action.
        chunk_size: particles evaluated at a time; 28 with 36 start states keep a CPU's cache.

    Raises:
        ValueError: if there are no start states, they are not finite, or a network is a fleet.  When called: if designs
            are not ``[P, D]`` or not finite.

    Note:
        For a fleet, cut out one run with :func:`~coim.models.select_run` first: designs are chosen run by run.

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
            design: where the networks read the query.
            state_action_value: written by the critics.
        """

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
        self, policy: TensorDictModule, qvalue: TensorDictModule, start_states: TensorDictBase, *, chunk_size: int = 28
    ) -> None:
        super().__init__()
        if start_states.batch_dims != 1 or not len(start_states):
            raise ValueError(
                f"start_states has batch size {list(start_states.batch_size)}; give [n] rows of Replay_s0, at least one"
            )
        if chunk_size < 1:
            raise ValueError(f"chunk_size={chunk_size} must be at least 1")
        check_num_runs(None, policy, qvalue)
        self.convert_to_functional(policy, "policy")
        self.convert_to_functional(qvalue, "qvalue")
        self.start_states = start_states.select(*policy.in_keys, *qvalue.in_keys, strict=False)
        self.chunk_size = chunk_size
        broken = [key for key, value in self.start_states.items(True, True) if not value.isfinite().all()]
        if broken:
            raise ValueError(f"start_states has NaN or infinite entries in {broken}; drop these rows")

    @property
    def in_keys(self) -> list[NestedKey]:
        """The design."""
        return [self.tensor_keys.design]

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        """There is no value estimator."""

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
        with (
            torch.set_grad_enabled(torch.is_grad_enabled() and designs.requires_grad),
            self.policy_params.data.to_module(self.policy, preserve_module_state=False),
            self.qvalue_params.data.to_module(self.qvalue, preserve_module_state=False),
        ):
            value = torch.cat([self._chunk(chunk) for chunk in designs.split(self.chunk_size)])
        return TensorDict({"design_value": value}, value.shape)

    def _chunk(self, designs: Tensor) -> Tensor:
        states = self.start_states.expand(len(designs), len(self.start_states))
        states.set(self.tensor_keys.design, designs.unsqueeze(1).expand(-1, len(self.start_states), -1))
        return design_value(self.qvalue(self.policy(states))[self.tensor_keys.state_action_value])

    def _check(self, designs: Tensor) -> None:
        size = self.start_states.get(self.tensor_keys.design, designs).shape[-1]
        if designs.dim() != 2 or designs.shape[-1] != size:
            raise ValueError(f"designs of shape {list(designs.shape)} must be [P, {size}]: one row for each candidate")
        if not designs.isfinite().all():
            bad = (~designs.isfinite().all(-1)).nonzero().flatten().tolist()
            raise ValueError(f"designs {bad} have NaN or infinite entries; project them with design_spec.project()")
