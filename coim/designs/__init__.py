"""Generators G of imagined designs, and searches for the next body.

A generator is a callable ``(design, *, rng=None) -> design`` (:class:`DesignGenerator`). A search is an object with
``maximise(fitness) -> (design, value)`` (:class:`DesignSearch`). A class with that one method adds another of either.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from coim.lazy import lazy_names

if TYPE_CHECKING:
    from .generators import DesignGenerator, KnownDesigns, NoisyDesigns, RandomDesigns
    from .gradient_search import GradientSearch
    from .search import DesignSearch
    from .swarm import ParticleSwarm
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "generators": ["DesignGenerator", "KnownDesigns", "NoisyDesigns", "RandomDesigns"],
            "gradient_search": ["GradientSearch"],
            "search": ["DesignSearch"],
            "swarm": ["ParticleSwarm"],
        },
    )

__all__ = [
    "DesignGenerator",
    "DesignSearch",
    "GradientSearch",
    "KnownDesigns",
    "NoisyDesigns",
    "ParticleSwarm",
    "RandomDesigns",
]
