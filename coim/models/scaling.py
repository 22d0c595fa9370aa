"""Scale the inputs of policy and critics to similar magnitudes.

Shapes: ``B`` batch, ``S`` state, ``D`` design.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchrl.envs import EnvBase

from .bodies import body_of, design_bounds


class InputScaling(nn.Module):
    """Divide observations by their typical spread, and map designs from their bounds to [-1, 1].

    Joint velocities are twenty times as large as joint angles, and would dominate the input without scaling
    (docs/results has the cost). The spreads are constants of the body, not running statistics: they never change, and
    are the same for all arms, seeds and networks, target critics included.

    Args:
        observation_scale: typical spread of each entry, ``[S]``.
        low: lowest design, ``[D]``.
        high: highest design, ``[D]``.
        bounded: which entries of the design have both bounds, ``[D]``; the others are not scaled. None: all have.

    Raises:
        ValueError: if a spread or a range is not positive.

    Example:
        >>> scaling = InputScaling(torch.tensor([0.5, 10.0]), torch.tensor([0.8]), torch.tensor([2.0]))
        >>> observation, design = scaling(torch.tensor([1.0, 5.0]), torch.tensor([2.0]))
        >>> observation, design
        (tensor([2.0000, 0.5000]), tensor([1.]))
    """

    observation_scale: Tensor
    design_centre: Tensor
    design_reach: Tensor

    def __init__(self, observation_scale: Tensor, low: Tensor, high: Tensor, *, bounded: Tensor | None = None) -> None:
        super().__init__()
        if not (observation_scale > 0).all():
            raise ValueError(
                f"observation scales {observation_scale.tolist()} must be positive; 1 leaves an entry alone"
            )
        if not (high > low).all():
            raise ValueError(f"design bounds {low.tolist()} and {high.tolist()} must leave a range in every entry")
        self.register_buffer("observation_scale", observation_scale.clone())
        bounded = torch.ones_like(low, dtype=torch.bool) if bounded is None else bounded
        self.register_buffer("design_centre", ((high + low) / 2).where(bounded, 0.0))
        self.register_buffer("design_reach", ((high - low) / 2).where(bounded, 1.0))

    @classmethod
    def for_env(cls, env: EnvBase) -> InputScaling:
        """Make the scaling of an environment from its body's ``observation_scale`` and the bounds of its designs.

        It is the same for a body, for its dream, and for both inside of transforms or of several workers. Observations
        are not scaled if the body has no constants, or if a transform changes them: the constants then do not fit, and
        `ObservationNorm` or `VecNorm` has scaled them already.

        Args:
            env: as for :func:`~coim.models.make_policy`.

        Raises:
            ValueError: as :func:`~coim.models.bodies.body_of` and :func:`~coim.models.bodies.design_bounds`.
        """
        body, rewritten = body_of(env)
        scale = None if rewritten else getattr(body, "observation_scale", None)
        low, high, bounded = design_bounds(env)
        scale = low.new_ones(env.observation_spec["observation"].shape[-1]) if scale is None else scale.to(low)
        return cls(scale, low, high, bounded=bounded)

    def forward(self, observation: Tensor, design: Tensor) -> tuple[Tensor, Tensor]:
        """Scale observation and design, ``[*B, S]`` and ``[*B, D]``.

        Raises:
            ValueError: if they have other sizes, as those of another body.
        """
        sizes = (len(self.observation_scale), len(self.design_centre))
        if (found := (observation.shape[-1], design.shape[-1])) != sizes:
            raise ValueError(
                f"observation and design have {found[0]} and {found[1]} numbers, this network was made for a body with "
                f"{sizes[0]} and {sizes[1]}; make it by make_policy or make_qvalue for this body"
            )
        return observation / self.observation_scale, self.scaled_design(design)

    def scaled_design(self, design: Tensor) -> Tensor:
        """Map designs from their bounds to [-1, 1], ``[*B, D]``."""
        return (design - self.design_centre) / self.design_reach
