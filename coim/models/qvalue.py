"""The design-conditioned critics Q(s, a, xi).

Shapes: ``B`` batch, ``K`` runs, ``N`` critics, ``S`` state, ``A`` action, ``D`` design.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import EnvBase

from .bodies import observed
from .scaling import InputScaling
from .stacked import StackedMLP


class QValueNetwork(nn.Module):
    """Tensor-level critics: ``(observation, action, design) -> values``.

    Args:
        num_observations: ``S``.
        num_actions: ``A``.
        num_designs: ``D``.
        num_critics: ``N``, critics with weights of their own.
        num_cells: units of each hidden layer.
        num_runs: ``K``, or None for a single run.
        scaling: of the inputs; None takes them as they are.

    Example:
        >>> network = QValueNetwork(11, 3, 4, num_cells=(32,))
        >>> network(torch.zeros(5, 11), torch.zeros(5, 3), torch.ones(5, 4)).shape
        torch.Size([5, 2])
    """

    def __init__(
        self,
        num_observations: int,
        num_actions: int,
        num_designs: int,
        *,
        num_critics: int = 2,
        num_cells: Sequence[int] = (200, 200, 200),
        num_runs: int | None = None,
        scaling: InputScaling | None = None,
    ) -> None:
        super().__init__()
        self.scaling = scaling
        size = num_observations + num_actions + num_designs
        self.mlp = StackedMLP(size, 1, num_cells, num_runs=num_runs, num_copies=num_critics)

    def forward(self, observation: Tensor, action: Tensor, design: Tensor) -> Tensor:
        """Evaluate all critics.

        Args:
            observation: ``[*B, (K,) S]``.
            action: ``[*B, (K,) A]``.
            design: ``[*B, (K,) D]``.

        Returns:
            ``[*B, (K,) N]``.
        """
        if self.scaling is not None:
            observation, design = self.scaling(observation, design)
        return self.mlp(observation, action, design).squeeze(-1)


class QValue(TensorDictModule):
    """The critics as a TensorDict module: reads ``observation``, ``action``, ``design``; writes ``state_action_value``.

    With one critic, its output ``[*B, 1]`` has the shape that TorchRL's losses expect.

    Args:
        network: kept as ``qvalue.module``.

    Example:
        >>> from tensordict import TensorDict
        >>> qvalue = QValue(QValueNetwork(11, 3, 4, num_critics=1, num_cells=(32,)))
        >>> row = {"observation": torch.zeros(5, 11), "action": torch.zeros(5, 3), "design": torch.ones(5, 4)}
        >>> qvalue(TensorDict(row, [5]))["state_action_value"].shape
        torch.Size([5, 1])
    """

    def __init__(self, network: QValueNetwork) -> None:
        super().__init__(network, in_keys=["observation", "action", "design"], out_keys=["state_action_value"])

    def values(self, observation: Tensor, action: Tensor, design: Tensor) -> Tensor:
        """Evaluate all critics on tensors, see :meth:`QValueNetwork.forward`."""
        return self.module(observation, action, design)

    @property
    def num_runs(self) -> int | None:
        """``K``, or None for a single run."""
        return self.module.mlp.num_runs


def make_qvalue(
    env: EnvBase, *, num_critics: int = 2, num_cells: Sequence[int] = (200, 200, 200), num_runs: int | None = None
) -> QValue:
    """Build critics that fit an environment (Sec. 6.1: three hidden layers of 200 units).

    Args:
        env: as for :func:`~coim.models.make_policy`; its actions may have any bounds.
        num_critics: ``N``; two in the double-Q approach of Sec. 4.
        num_cells: units of each hidden layer.
        num_runs: ``K`` independent sets of critics in one; the last batch dimension of their input is then the run
            axis.

    Returns:
        Critics on the device and in the dtype of the observations; their weights are drawn on the CPU.

    Raises:
        ValueError: if ``env`` has no designs, or its workers differ.

    Example:
        >>> import torch
        >>> qvalue = QValue(QValueNetwork(17, 6, 6))
        >>> qvalue.module(torch.zeros(256, 17), torch.zeros(256, 6), torch.ones(256, 6)).shape
        torch.Size([256, 2])
    """
    seen, scaling = observed(env), InputScaling.for_env(env)
    with torch.device("cpu"):
        network = QValueNetwork(
            seen.shape[-1],
            env.action_spec.shape[-1],
            len(scaling.design_centre),
            num_critics=num_critics,
            num_cells=num_cells,
            num_runs=num_runs,
            scaling=scaling,
        )
    return QValue(network.to(seen.device, seen.dtype))
