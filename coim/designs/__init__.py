"""Generators G of imagined designs, searches for the next body, and the posterior over designs.

A generator is a callable ``(design, *, rng=None) -> design`` (:class:`DesignGenerator`). A search is an object with
``maximise(fitness) -> (design, value)`` (:class:`DesignSearch`). A class with that one method adds another of either.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING

from coim.lazy import lazy_names

if TYPE_CHECKING:
    from .generators import DesignGenerator, KnownDesigns, NoisyDesigns, RandomDesigns
    from .gradient_search import GradientSearch
    from .posterior import DesignPosterior
    from .search import DesignSearch
    from .swarm import ParticleSwarm
    from .trust_region import TrustRegion
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "generators": ["DesignGenerator", "KnownDesigns", "NoisyDesigns", "RandomDesigns"],
            "gradient_search": ["GradientSearch"],
            "posterior": ["DesignPosterior"],
            "search": ["DesignSearch"],
            "swarm": ["ParticleSwarm"],
            "trust_region": ["TrustRegion"],
        },
    )

__all__ = [
    "DesignGenerator",
    "DesignPosterior",
    "DesignSearch",
    "GradientSearch",
    "KnownDesigns",
    "NoisyDesigns",
    "ParticleSwarm",
    "RandomDesigns",
    "TrustRegion",
]

if not TYPE_CHECKING and find_spec("botorch") is None:  # it is optional, and "import *" asks for every name
    __all__.remove("DesignPosterior")
