"""The design-conditioned policy pi(a | s, xi), a tanh-Gaussian.

Shapes: ``B`` batch, ``K`` runs, ``S`` state, ``D`` design, ``A`` action.

References:
    Haarnoja et al. 2018, Soft Actor-Critic (arXiv:1801.01290), [9] of the paper: the tanh-Gaussian.
    rlkit (github.com/rail-berkeley/rlkit), on which the paper's baseline [16] builds: the range of the log-scale.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import cast

import torch
from tensordict.nn import InteractionType, TensorDictModule
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor, SafeProbabilisticModule, TanhNormal

from coim.calling import altered_part

from .bodies import observed
from .scaling import InputScaling
from .stacked import StackedLinear, StackedMLP

LOG_SCALE_RANGE = (-20.0, 2.0)  # rlkit's LOG_SIG_MIN, LOG_SIG_MAX


class PolicyNetwork(nn.Module):
    """Tensor-level policy: ``(observation, design) -> (loc, scale)`` of the Gaussian before the tanh.

    Args:
        num_observations: ``S``.
        num_designs: ``D``.
        num_actions: ``A``.
        num_cells: units of each hidden layer.
        num_runs: ``K``, or None for a single run.
        scaling: of the inputs; None takes them as they are.

    Example:
        >>> network = PolicyNetwork(11, 4, 3, num_cells=(32,))
        >>> loc, scale = network(torch.zeros(5, 11), torch.ones(5, 4))
        >>> loc.shape, scale.shape
        (torch.Size([5, 3]), torch.Size([5, 3]))
    """

    mlp: StackedMLP
    scaling: InputScaling | None

    def __init__(
        self,
        num_observations: int,
        num_designs: int,
        num_actions: int,
        *,
        num_cells: Sequence[int] = (200, 200, 200),
        num_runs: int | None = None,
        scaling: InputScaling | None = None,
    ) -> None:
        super().__init__()
        self.scaling = scaling
        self.mlp = StackedMLP(num_observations + num_designs, 2 * num_actions, num_cells, num_runs=num_runs)

    def forward(self, observation: Tensor, design: Tensor) -> tuple[Tensor, Tensor]:
        """Evaluate the network.

        Args:
            observation: ``[*B, (K,) S]``.
            design: ``[*B, (K,) D]``.

        Returns:
            ``loc`` and ``scale``, each ``[*B, (K,) A]``; ``scale`` lies in ``exp(LOG_SCALE_RANGE)``.
        """
        if self.scaling is not None:
            observation, design = self.scaling(observation, design)
        loc, log_scale = self.mlp(observation, design).chunk(2, -1)
        return loc, log_scale.clamp(*LOG_SCALE_RANGE).exp()

    def constants(self, design: Tensor) -> tuple[list[tuple[Tensor, Tensor]], Tensor, Tensor]:
        """Return what does not change during an episode, without gradients.

        Args:
            design: ``[K, D]``, a row for each body.

        Returns:
            Weight ``[(K,) inputs, outputs]`` and bias ``[(K,) outputs]`` of each layer, as they lie in memory; what
            observations are divided by, ``[S]``; and the designs as the first layer reads them, ``[K, D]``.
        """
        layers = [
            (layer.weight.detach(), layer.bias.detach()) for layer in cast(Iterable[StackedLinear], self.mlp.layers)
        ]
        if self.scaling is None:
            return layers, design.new_ones(self.mlp.in_features - design.shape[-1]), design
        return layers, self.scaling.observation_scale, self.scaling.scaled_design(design)

    def for_design(self, design: Tensor) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
        """Return a faster `forward` for an episode, in which the designs are constant; see `Policy.is_unaltered`.

        Look-ups, the scaling of the design and the memory layout are done once; the arithmetic is the same. Each call
        reads the weights, so the function follows a learner that changes them in place.

        Args:
            design: ``[K, D]``, a row for each body.

        Returns:
            A function of observations ``[K, S]`` that returns ``loc`` and ``scale``, ``[K, A]``, without gradients.
        """
        layers, scale, scaled = self.constants(design)
        fleet = self.mlp.num_runs is not None
        if fleet:
            layers = [(weight, bias.unsqueeze(1)) for weight, bias in layers]
        (*hidden, (last_weight, last_bias)) = layers
        product = torch.baddbmm if fleet else torch.addmm
        num_observations = len(scale)
        inputs = design.new_empty(len(design), self.mlp.in_features)
        inputs[:, num_observations:] = scaled
        observed, first = inputs[:, :num_observations], inputs.unsqueeze(1) if fleet else inputs

        def network(observation: Tensor) -> tuple[Tensor, Tensor]:
            torch.div(observation, scale, out=observed)
            x = first
            for weight, bias in hidden:
                x = product(bias, x, weight).relu_()
            loc, log_scale = product(last_bias, x, last_weight).view(len(design), -1).chunk(2, -1)
            return loc, log_scale.clamp(*LOG_SCALE_RANGE).exp_()

        return network


class Policy(ProbabilisticActor):
    """The policy as a TorchRL actor: reads ``observation``, ``design``; writes ``loc``, ``scale``, ``action`` and
    ``action_log_prob``.

    It samples by default; under ``set_exploration_type(ExplorationType.DETERMINISTIC)`` it acts by ``tanh(loc)``.
    Actions lie in [-1, 1].

    Args:
        network: ``(observation, design) -> (loc, scale)``, kept as ``policy.network``.

    Example:
        >>> from tensordict import TensorDict
        >>> policy = Policy(PolicyNetwork(11, 4, 3, num_cells=(32,)))
        >>> td = policy(TensorDict({"observation": torch.zeros(5, 11), "design": torch.ones(5, 4)}, [5]))
        >>> td["action"].shape, td["action_log_prob"].shape
        (torch.Size([5, 3]), torch.Size([5]))
    """

    def __init__(self, network: PolicyNetwork) -> None:
        super().__init__(
            TensorDictModule(network, in_keys=["observation", "design"], out_keys=["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=TanhNormal,
            return_log_prob=True,
            default_interaction_type=InteractionType.RANDOM,
        )

    @property
    def network(self) -> PolicyNetwork:
        """The tensor-level network."""
        return self.module[0].module

    def deterministic_action(self, observation: Tensor, design: Tensor) -> Tensor:
        """Return the deterministic action ``tanh(loc)``: ``[*B, (K,) S], [*B, (K,) D] -> [*B, (K,) A]``."""
        return self.network(observation, design)[0].tanh()

    @property
    def num_runs(self) -> int | None:
        """``K``, or None for a single run."""
        return self.network.mlp.num_runs

    def is_unaltered(self) -> bool:
        """Return whether calling the policy gives the same result as `PolicyNetwork.for_design`.

        It does not if any part has another activation or distribution, hooks, or a `forward` of its own.
        """
        actor = (Policy, TensorDictModule, SafeProbabilisticModule)
        network = (PolicyNetwork, InputScaling, StackedMLP, nn.ModuleList, StackedLinear, nn.ReLU)
        head = self[-1]
        plain = head.distribution_class is TanhNormal and not head.distribution_kwargs
        return plain and altered_part(self, (*actor, *network)) is None


def make_policy(env: EnvBase, *, num_cells: Sequence[int] = (200, 200, 200), num_runs: int | None = None) -> Policy:
    """Build a policy that fits an environment (Sec. 6.1: three hidden layers of 200 units).

    Args:
        env: any environment with ``observation_spec``, ``action_spec`` and bounds of the design, in the spec of its
            observation or as ``design_spec``: a body, its dream, or one of these inside of transforms, `SerialEnv` or
            `ParallelEnv`. The scaling of the inputs is the same for all of them, see :meth:`InputScaling.for_env`.
        num_cells: units of each hidden layer.
        num_runs: ``K`` independent policies in one; the last batch dimension of their input is then the run axis.

    Returns:
        A policy on the device and in the dtype of the observations. Weights are drawn on the CPU: a seed gives the same
        policy on every device.

    Raises:
        ValueError: if the actions of ``env`` are not bounded by -1 and 1, it has no ``observation`` or no designs, or
            its workers differ.

    Example:
        >>> policy = Policy(PolicyNetwork(17, 6, 6))
        >>> loc, scale = policy.network(torch.zeros(256, 17), torch.ones(256, 6))
        >>> loc.shape
        torch.Size([256, 6])
    """
    space = env.action_spec.space
    if not hasattr(space, "low") or not (torch.all(space.low == -1) and torch.all(space.high == 1)):
        raise ValueError(f"a tanh policy acts in [-1, 1], not in {space}; rescale with torchrl.envs.ActionScaling")
    seen, scaling = observed(env), InputScaling.for_env(env)
    with torch.device("cpu"):
        network = PolicyNetwork(
            seen.shape[-1],
            len(scaling.design_centre),
            env.action_spec.shape[-1],
            num_cells=num_cells,
            num_runs=num_runs,
            scaling=scaling,
        )
    return Policy(network.to(seen.device, seen.dtype))
