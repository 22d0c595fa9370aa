"""Search for the next body by particle swarm optimisation.

Shapes: ``*B`` any batch, ``D`` design entries, ``P`` particles (candidate designs tried at once).

References:
    Co-Imagination of Behaviour and Morphology of Agents: Eq. 5 (what is maximised), Sec. 4.

    J. Kennedy and R. Eberhart, *Particle swarm optimization*, IEEE International Conference on Neural Networks, 1995;
    as implemented in `pyswarms <https://pyswarms.readthedocs.io>`_.
"""

from __future__ import annotations

import logging.config
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal
from unittest import mock

import numpy as np
import torch
from torch import Tensor
from torchrl.data import Bounded

from .bounds import bounds_of
from .search import Fitness, evaluate

_PROCESS_WIDE = threading.Lock()  # held while numpy's global state or the logging configuration is replaced


@contextmanager
def _no_reports() -> Iterator[None]:
    """Stop pyswarms from configuring the logging, which would also create ``report.log`` in the working directory.

    All of its modules and handlers make a reporter that does so, at import or when they are made.
    """
    with _PROCESS_WIDE, mock.patch.object(logging.config, "dictConfig"):
        yield


with _no_reports():
    from pyswarms.backend.generators import create_swarm
    from pyswarms.backend.handlers import BoundaryHandler, VelocityHandler
    from pyswarms.backend.operators import compute_pbest
    from pyswarms.backend.swarms import Swarm
    from pyswarms.backend.topology import Star


class ParticleSwarm:
    """Particle swarm optimisation with a global best, made of pyswarms' operators (Sec. 4, "Design Optimisation").

    All particles are evaluated in one call, ``[P, D] -> [P]``. The paper does not give the settings. These are those of
    its baseline (ksluck/Coadaptation), except for the bounds. In the baseline, a particle that leaves the design space
    on one side enters it again on the other (``bounds="periodic"``). Such a swarm does not converge to an edge: when it
    maximises the sum of six entries, it reaches 11.3 to 11.5 of 12, and ``"nearest"`` reaches 12.

    The swarm has its own random numbers, which continue from call to call. pyswarms changes numpy's global state and
    the logging configuration, and writes to the working directory; after each call, all three are as before.

    Args:
        spec: bounds of one design, ``[D]``, as ``env.design_spec``; its device and dtype are the candidates'.
        num_particles: candidate designs per iteration.
        num_iterations: moves of the swarm.
        c1: attraction to the best position of the particle itself.
        c2: attraction to the best position of all particles.
        w: inertia, the share of its velocity that a particle keeps.
        bounds: what happens to a particle outside of the design space: ``"nearest"`` clips it to the edge,
            ``"periodic"`` lets it enter on the other side.
        seed: seed of the swarm's random numbers, from 0 to 2**32 - 1; None takes a random one.

    Raises:
        ValueError: if ``spec`` is not one bounded design, a number of particles or iterations is below 1, ``bounds`` is
            an unknown option, or ``seed`` is out of its range.

    Note:
        The swarm replaces numpy's global state while it moves. Another thread that draws from it at that time gets
        the swarm's numbers; swarms of several threads move one at a time. During ``fitness``, the global state is the
        caller's.

    Example:
        >>> search = ParticleSwarm(Bounded(low=0.8, high=2.0, shape=(2,)), num_particles=50, num_iterations=60, seed=0)
        >>> design, value = search.maximise(lambda designs: -(designs - 1.5).square().sum(-1))
        >>> design.round(decimals=2), round(value, 4)
        (tensor([1.5000, 1.5000]), -0.0)
    """

    def __init__(
        self,
        spec: Bounded,
        *,
        num_particles: int = 700,
        num_iterations: int = 250,
        c1: float = 0.5,
        c2: float = 0.3,
        w: float = 0.9,
        bounds: Literal["nearest", "periodic"] = "nearest",
        seed: int | None = None,
    ) -> None:
        if min(num_particles, num_iterations) < 1:
            raise ValueError(f"{num_particles} particles x {num_iterations} iterations: both must be at least 1")
        if bounds not in ("nearest", "periodic"):
            raise ValueError(f"bounds={bounds!r} is an unknown option; take 'nearest' or 'periodic'")
        if seed is not None and not 0 <= seed < 2**32:
            raise ValueError(f"seed={seed} is outside 0 .. {2**32 - 1}, which numpy takes; pass seed % 2**32")
        self.spec = spec
        self._low, self._high = bounds_of(spec)
        self.bounds = bounds
        self.num_particles = num_particles
        self.num_iterations = num_iterations
        self.options = {"c1": c1, "c2": c2, "w": w}
        # pyswarms draws from numpy's global generator, and this is the legacy format of its state.
        self._random_state: Any = np.random.RandomState(seed).get_state()

    def maximise(self, fitness: Fitness) -> tuple[Tensor, float]:
        """Find the design of highest fitness.

        Args:
            fitness: maps candidates ``[P, D]``, always inside the bounds, to values ``[P]``; called without gradients.

        Returns:
            The best design tried, ``[D]``, and its value.

        Raises:
            ValueError: if the fitness returns another shape, or a value that is not finite.
        """
        low, high = (bound.double().cpu().numpy() for bound in (self._low, self._high))
        # A fixed entry moves freely, and candidates have it where it is: a periodic one of no length would be NaN.
        limits = (low, np.where(high > low, high, low + 1))
        with _no_reports():
            star, edge, pace = Star(), BoundaryHandler(strategy=self.bounds), VelocityHandler(strategy="unmodified")
        with self._own_random_numbers():
            swarm: Swarm = create_swarm(self.num_particles, len(limits[0]), options=self.options, bounds=limits)
        swarm.pbest_cost = np.full(self.num_particles, np.inf)
        for _ in range(self.num_iterations):
            with torch.no_grad():
                values = evaluate(fitness, self._candidates(swarm.position))
            swarm.current_cost = -values.double().cpu().numpy()
            swarm.pbest_pos, swarm.pbest_cost = compute_pbest(swarm)
            swarm.best_pos, swarm.best_cost = star.compute_gbest(swarm)
            with self._own_random_numbers():
                swarm.velocity = star.compute_velocity(swarm, vh=pace)
            swarm.position = star.compute_position(swarm, limits, edge)
        return self._candidates(swarm.best_pos), -float(swarm.best_cost)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the swarm's random numbers; it has no other state."""
        _, key, position, *_ = self._random_state
        return {"key": torch.from_numpy(key.astype(np.int64)), "position": int(position)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the random numbers from :meth:`state_dict`."""
        # The last two entries hold a normal number kept for the next draw; only uniform numbers are drawn here.
        key = state_dict["key"].cpu().numpy().astype(np.uint32)
        self._random_state = ("MT19937", key, state_dict["position"], 0, 0.0)

    def _candidates(self, position: np.ndarray) -> Tensor:
        """Convert pyswarms' float64 positions to designs, ``[*B, D]``, exactly inside the bounds."""
        return torch.as_tensor(position, dtype=self._low.dtype, device=self._low.device).clamp(self._low, self._high)

    @contextmanager
    def _own_random_numbers(self) -> Iterator[None]:
        """Replace numpy's global state by the swarm's, and restore it at the end."""
        with _PROCESS_WIDE:
            outside = np.random.get_state()  # noqa: NPY002
            np.random.set_state(self._random_state)  # noqa: NPY002
            try:
                yield
            finally:
                self._random_state = np.random.get_state()  # noqa: NPY002
                np.random.set_state(outside)  # noqa: NPY002
