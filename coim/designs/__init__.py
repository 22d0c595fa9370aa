"""Where designs come from: the generators G of the imagination, and the searches for the next body.

A generator is a callable ``(design, *, rng=None) -> design`` (:class:`DesignGenerator`), a search an object with
``maximise(fitness) -> (design, value)`` (:class:`DesignSearch`); one class with one method adds another of either.
"""

from .generators import DesignGenerator, KnownDesigns, NoisyDesigns, RandomDesigns
from .gradient_search import GradientSearch
from .search import DesignSearch
from .swarm import ParticleSwarm

__all__ = [
    "DesignGenerator",
    "DesignSearch",
    "GradientSearch",
    "KnownDesigns",
    "NoisyDesigns",
    "ParticleSwarm",
    "RandomDesigns",
]
