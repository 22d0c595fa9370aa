"""Known returns of bodies, to try searches on that see them through noise: the preview study's, and test functions.

Shapes: ``P`` designs, ``D`` design entries, ``C`` coefficients.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded

from benchmarks.networks import load
from benchmarks.value_states import CELLS, visited
from coim import DesignValue, MorphEnv, Policy, QValue
from coim.designs.search import Fitness
from coim.experiments.frames import read_frame
from coim.run_folder import DESIGNS
from coim.tables import DESIGN_PREFIX

NOISE = 440.0  # deviation of the best return of one body from run to run, in the preview study's Hoppers
RIDGE = 3.0  # of the pooled surface's coefficients: 16 from 300 returns

# The preview study's first designs of the Hopper, as `coim.HopperMorph` has them.
FIRST = (
    (1, 1, 1, 1),
    (1.91, 1.27, 1.96, 0.62),
    (1.41, 1.06, 1.7, 0.76),
    (1.81, 1.32, 1.85, 1.22),
    (1.15, 1.68, 1.98, 1.05),
)


@dataclass(frozen=True)
class Surface:
    """What bodies are worth, and what a study sees of it.

    Attributes:
        name: in the tables.
        spec: bounds of one design.
        first: designs that every study begins with, ``[5, D]``.
        truth: expected return, ``[P, D] -> [P]``.
        noise: deviation of a return around it.
        trend: return that a study gains from its first body to its last, whatever they are.
    """

    name: str
    spec: Bounded
    first: Tensor
    truth: Fitness
    noise: float
    trend: float

    def box(self, number: int = 20_000) -> Tensor:
        """Return uniform designs, always the same."""
        return uniform(self.spec, number, torch.Generator().manual_seed(0))


@dataclass(frozen=True)
class Tried:
    """A body that a stored run tried; ``returned`` is its best return."""

    run: str
    number: int
    kind: str
    design: Tensor
    returned: float


def uniform(spec: Bounded, number: int, rng: torch.Generator) -> Tensor:
    """Designs ``[number, D]`` from the whole space."""
    low, high = spec.space.low, spec.space.high
    return low + (high - low) * torch.rand(number, len(low), generator=rng)


def stored(environment: str, cells: Path = CELLS) -> list[Tried]:
    """Every body that the preview study tried in an environment, in the order of building within its run."""
    found = []
    for file in sorted(cells.glob(f"{environment}-*/designs.csv")):
        table = read_frame(file, DESIGNS)
        designs = torch.tensor(table.filter(like=DESIGN_PREFIX).to_numpy(), dtype=torch.float32)
        told = zip(table["design"], table["kind"], designs, table["best_return"])
        found += [Tried(file.parent.name, number, kind, design, best) for number, kind, design, best in told]
    return found


def pooled(tried: list[Tried], *, noise: float = NOISE, name: str = "Hopper, pooled returns") -> Surface:
    """A quadratic in the design plus a trend, fitted by ridge regression to all bodies of many runs of 15 designs."""
    low, high = 0.5, 2.0

    def features(designs: Tensor) -> Tensor:
        z = (2 * designs - low - high) / (high - low)
        products = [z[:, i] * z[:, j] for i in range(z.shape[-1]) for j in range(i + 1)]
        return torch.cat([torch.ones(len(z), 1), z, torch.stack(products, -1)], -1)

    order = torch.tensor([[body.number / 15] for body in tried])
    x = torch.cat([features(torch.stack([body.design for body in tried])), order], -1).double()
    y = torch.tensor([body.returned for body in tried]).double()
    weights = torch.linalg.solve(x.T @ x + RIDGE * torch.eye(x.shape[-1]), x.T @ y).float()
    spec = Bounded(low=low, high=high, shape=(4,), dtype=torch.float32)
    # In the middle of a run, where the trend of a study that is centred there vanishes.
    return Surface(
        name,
        spec,
        torch.tensor(FIRST),
        lambda d: features(d) @ weights[:-1] + weights[-1] / 2,
        noise,
        weights[-1].item(),
    )


def hartmann(*, deviation: float = 256.0, noise: float = NOISE) -> Surface:
    """Hartmann's function of six entries, scaled to the deviation between bodies that the pooled surface has."""
    from botorch.test_functions import Hartmann

    function = Hartmann(dim=6, negate=True)
    spec = Bounded(low=0.0, high=1.0, shape=(6,), dtype=torch.float32)
    box = uniform(spec, 20_000, torch.Generator().manual_seed(0))
    scale = deviation / function(box).std()
    first = uniform(spec, 5, torch.Generator().manual_seed(1))
    return Surface("Hartmann, six entries", spec, first, lambda d: scale * function(d), noise, 0.0)


@lru_cache(maxsize=1)
def _trained() -> tuple[MorphEnv, Policy, QValue, TensorDict, TensorDict]:
    env, policy, qvalue, starts = load("hopper")
    return env, policy, qvalue, starts, visited(env, policy, starts, 1000)


def trained_critic(how: str, seed: int, *, num_states: int = 36) -> Fitness:
    """Eq. 5 of the Hopper networks in ``benchmarks/data``, over "stored" start states or "matched" visited ones.

    Another draw of states for each seed; the networks are always the same.
    """
    env, policy, qvalue, starts, seen = _trained()
    source = starts if how == "stored" else seen
    states = source[torch.randint(len(source), (num_states,), generator=torch.Generator().manual_seed(seed))]
    return DesignValue(policy, qvalue, states, start_states_are=how, env=env)


def made_up_critic(surface: Surface, correlation: float, seed: int) -> Fitness:
    """A smooth function that correlates with the truth over the whole space as it shall; another for each seed.

    The rest of it is a sum of 32 random waves, most of them longer than half the range of an entry.
    """
    rng = torch.Generator().manual_seed(seed)
    low, high = surface.spec.space.low, surface.spec.space.high
    waves, phases = 2 * torch.randn(len(low), 32, generator=rng), 6.2832 * torch.rand(32, generator=rng)
    heights = torch.randn(32, generator=rng)

    def other(designs: Tensor) -> Tensor:
        return torch.cos((designs - low) / (high - low) @ waves + phases) @ heights

    truth, other = _standardised(surface.truth, surface.box()), _standardised(other, surface.box())
    shared = float((truth(surface.box()) * other(surface.box())).mean())
    rest = _standardised(lambda designs: other(designs) - shared * truth(designs), surface.box())
    return lambda designs: correlation * truth(designs) + (1 - correlation**2) ** 0.5 * rest(designs)


def _standardised(function: Callable[[Tensor], Tensor], box: Tensor) -> Fitness:
    """The same with mean 0 and deviation 1 over the box."""
    values = function(box)
    mean, deviation = values.mean(), values.std()
    return lambda designs: (function(designs) - mean) / deviation
