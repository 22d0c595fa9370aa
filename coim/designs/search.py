"""The protocol of a search for the next body, and the checks on the fitness that it maximises.

Shapes: ``D`` design entries, ``P`` candidate designs tried at once.

References:
    Co-Imagination of Behaviour and Morphology of Agents: Eq. 5.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from torch import Tensor

Fitness = Callable[[Tensor], Tensor]


class DesignSearch(Protocol):
    """A search for the next body: it maximises a fitness such as :class:`coim.DesignValue`.

    If it has its bounds as ``spec``, `coim.CoAdaptation` refuses bounds that do not fit the bodies.

    If its random numbers continue from call to call, it also needs ``state_dict`` and ``load_state_dict``. Without
    them, a resumed run draws other numbers than an uninterrupted one.

    Example:
        >>> import torch
        >>> class Corners:
        ...     def maximise(self, fitness):
        ...         designs = torch.cartesian_prod(*[torch.tensor([0.5, 2.0])] * 2)
        ...         values = fitness(designs)
        ...         return designs[values.argmax()], float(values.max())
        >>> Corners().maximise(lambda designs: designs @ torch.tensor([1.0, -1.0]))
        (tensor([2.0000, 0.5000]), 1.5)
    """

    def maximise(self, fitness: Fitness) -> tuple[Tensor, float]:
        """Return the best design ``[D]`` found and its fitness; ``fitness`` maps ``[P, D]`` to ``[P]``."""


def evaluate(fitness: Fitness, designs: Tensor) -> Tensor:
    """Call a fitness and check its result, ``[P, D] -> [P]``.

    Raises:
        ValueError: if it returns no tensor, another shape, or a value that is not finite.
    """
    values = fitness(designs)
    if not isinstance(values, Tensor):
        raise ValueError(
            f"the fitness returned a {type(values).__name__}; return a tensor [P], as by torch.from_numpy(values)"
        )
    if values.shape != designs.shape[:1]:
        raise ValueError(
            f"the fitness of {len(designs)} designs has shape {list(values.shape)}, [{len(designs)}] is needed: "
            "return one value per design"
        )
    broken = ~values.isfinite()
    if broken.any():
        first = int(broken.nonzero()[0])
        raise ValueError(
            f"the fitness is {values[first].item()} for the design {designs[first].tolist()}, and not finite for "
            f"{int(broken.sum())} of {len(designs)} designs: check the networks that compute it"
        )
    return values
