"""What a way of choosing bodies would earn: simulated studies on known surfaces, with the noise that returns have.

``python -m benchmarks.choosing --out docs/results/choosing`` writes ``studies.csv``, a row for each simulated study,
and ``summary.csv`` from it. The same line again goes on where it stopped.

Shapes: ``N`` bodies built, ``P`` candidate designs, ``D`` design entries.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from statistics import stdev
from unittest import mock

import torch
import tyro
from scipy import stats
from torch import Tensor

from benchmarks.choosing_arms import ARMS, Arm
from benchmarks.surfaces import Surface, hartmann, made_up_critic, pooled, stored, trained_critic, uniform
from coim.designs import DesignPosterior, GradientSearch, TrustRegion
from coim.designs.search import Fitness
from coim.tables import Layout, read_table

KEY = ("surface", "arm", "critic", "designs")  # columns that tell arms apart
WITHIN_90 = 1.645  # deviations, of a normal distribution


SURFACES: dict[str, Callable[[], Surface]] = {
    "hopper": lambda: pooled(stored("hopper")),
    "hopper, a third of the noise": lambda: pooled(stored("hopper"), noise=150.0),
    "hartmann": hartmann,
}


@dataclass(frozen=True)
class Study:
    """What one simulated study came to.

    Attributes:
        gain: expected return of the bodies that were chosen, less that of a uniform one, without noise.
        last: the same of the last three of them.
        explored: the same of the bodies in between.
        covered_chosen, covered_explored: share of returns within the 90 % interval predicted for their bodies.
        listened: share of choices at which the slope on the critic was above 0.
    """

    surface: str
    arm: str
    critic: str
    designs: int
    seed: int
    gain: float
    last: float
    explored: float
    covered_chosen: float
    covered_explored: float
    listened: float


def study(arm: Arm, surface: Surface, seed: int) -> Study:
    """Simulate a study: the first designs, then a chosen one and another in turn, each seen once through the noise.

    A random body is predicted by the posterior that chose the body before it, to save half of the fits.
    """
    rng = torch.Generator().manual_seed(seed)
    noise = surface.noise * torch.randn(arm.designs, generator=rng)
    random = uniform(surface.spec, arm.designs, rng)
    values = _critic(arm, surface, seed)
    search = GradientSearch(surface.spec, num_starts=24, num_steps=15, seed=seed)
    first = len(surface.first)
    designs, returns = list(surface.first), torch.zeros(0)
    posterior = None
    covered: dict[bool, list[float]] = {True: [], False: []}
    listened = []
    for n in range(arm.designs):
        chosen = (n - first) % 2 == 0
        if n >= first:
            if arm.choose != "critic" and (chosen or arm.explore == "uncertain"):
                posterior = _posterior(arm, surface, torch.stack(designs), returns, values)
                listened.append(float(posterior.slope > 0))
            if chosen:
                best = torch.stack(designs)[returns.argmax()]
                designs.append(_chosen(arm, surface, posterior, values, search, best, n - first))
            elif arm.explore == "uncertain":
                designs.append(search.maximise(_deviation(posterior))[0])
            else:
                designs.append(random[n])
        rise = surface.trend * ((n + 1) / arm.designs - 0.5)
        seen = surface.truth(designs[n][None]) + rise + noise[n]
        if posterior is not None:
            mean, deviation = posterior.predict(designs[n][None])
            covered[chosen].append(float((seen - mean).abs() < WITHIN_90 * deviation))
        returns = torch.cat([returns, seen])
    worth = surface.truth(torch.stack(designs[first:])) - surface.truth(surface.box()).mean()
    return Study(
        surface=arm.surface,
        arm=arm.name,
        critic=str(arm.critic),
        designs=arm.designs,
        seed=seed,
        gain=worth[::2].mean().item(),
        last=worth[::2][-3:].mean().item(),
        explored=worth[1::2].mean().item(),
        covered_chosen=_mean(covered[True]),
        covered_explored=_mean(covered[False]),
        listened=_mean(listened),
    )


def _critic(arm: Arm, surface: Surface, seed: int) -> Fitness | None:
    if arm.critic is None:
        return None
    if isinstance(arm.critic, str):
        return trained_critic(arm.critic, seed)
    return made_up_critic(surface, arm.critic, seed)


def _mean(values: list[float]) -> float:
    return sum(values) / len(values) if values else math.nan


def _posterior(arm: Arm, surface: Surface, designs: Tensor, returns: Tensor, values: Fitness | None) -> DesignPosterior:
    with _priors(SPREAD=arm.spread, NOISE=arm.noise, LENGTH=arm.length):
        return DesignPosterior(surface.spec, designs, returns, prior=values, optimism=arm.optimism)


@contextmanager
def _priors(**constants: float | None) -> Iterator[None]:
    """Let the posterior's priors have other constants."""
    given = {name: value for name, value in constants.items() if value is not None}
    if not given:
        yield
        return
    with mock.patch.multiple("coim.designs.posterior", **given):
        yield


def _chosen(
    arm: Arm,
    surface: Surface,
    posterior: DesignPosterior | None,
    values: Fitness | None,
    search: GradientSearch,
    best: Tensor,
    later: int,
) -> Tensor:
    """The next body ``[D]``; ``best`` is the one with the highest return of the first ones and ``later`` others."""
    fitness = {"critic": values, "posterior": posterior, "improvement": None}[arm.choose]
    if fitness is None:
        fitness = _improvement(posterior)
    if arm.reach is None:
        return search.maximise(fitness)[0]
    reach = min(1.0, arm.reach + arm.widening * later)
    return TrustRegion(surface.spec, search, reach=reach).maximise(fitness, centre=best)[0]


def _deviation(posterior: DesignPosterior) -> Fitness:
    """How unsure the posterior is of the expected return."""
    return lambda designs: (
        posterior.model.posterior(posterior.inputs(designs).unsqueeze(-2)).stddev.flatten().to(designs)
    )


def _improvement(posterior: DesignPosterior) -> Fitness:
    """The logarithm of noisy expected improvement over the bodies built, each as if it were built anew."""
    # After coim.designs.posterior, which mutes a warning that BoTorch's import gives.
    from botorch.acquisition import qLogNoisyExpectedImprovement
    from botorch.sampling import SobolQMCNormalSampler

    baseline = posterior.model.train_inputs[0].clone()
    baseline[:, -2] = 1.0
    sampler = SobolQMCNormalSampler(torch.Size([64]), seed=0)
    gain = qLogNoisyExpectedImprovement(posterior.model, baseline, sampler=sampler, prune_baseline=False)
    return lambda designs: gain(posterior.inputs(designs).unsqueeze(-2)).to(designs)


def summary(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """A row for each arm: means over its studies, and 95 % intervals of the gain and of what it gains more.

    More than the posterior without a critic, on the same surface with the same noise and random bodies, seed by seed.
    """
    groups: dict[tuple[str, ...], dict[str, dict[str, str]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in KEY), {})[row["seed"]] = row
    table = []
    for key, found in groups.items():
        plain = groups.get((key[0], "posterior", "None", key[3]), {})
        gains = [float(row["gain"]) for row in found.values()]
        more = [float(row["gain"]) - float(plain[seed]["gain"]) for seed, row in found.items() if seed in plain]
        line = dict(zip(KEY, key)) | _interval("gain", gains) | _interval("more", more)
        for name in ("last", "explored", "covered_chosen", "covered_explored", "listened"):
            value = _mean([float(row[name]) for row in found.values()])
            line[name] = f"{value:.0f}" if name in ("last", "explored") else f"{value:.2f}"
        table.append(line | {"studies": str(len(found))})
    return table


def _interval(name: str, values: list[float]) -> dict[str, str]:
    if len(values) < 2:
        return {name: "", f"{name}_low": "", f"{name}_high": ""}
    half = stats.t.ppf(0.975, len(values) - 1) * stdev(values) / len(values) ** 0.5
    numbers = (_mean(values), _mean(values) - half, _mean(values) + half)
    return dict(zip((name, f"{name}_low", f"{name}_high"), (f"{number:.0f}" for number in numbers)))


COLUMNS = [field.name for field in fields(Study)]
LAYOUT = Layout(file="studies.csv", columns=dict.fromkeys(COLUMNS, str), needed=tuple(COLUMNS), grows=False)


@dataclass(frozen=True)
class Asked:
    """Simulate studies; what is in ``studies.csv`` already is not simulated again.

    Attributes:
        out: folder of the tables.
        studies: of each arm, with seeds from 0.
        arms: only the first so many; 0: all.
    """

    out: Path
    studies: int = 30
    arms: int = 0


def main(asked: Asked) -> None:
    """Write the tables, after each arm."""
    torch.set_num_threads(1)
    asked.out.mkdir(parents=True, exist_ok=True)
    file = asked.out / "studies.csv"
    # As text: what was simulated before is written again as it stands.
    table = read_table(file, LAYOUT)
    rows = [dict(zip(table, map(str, cells))) for cells in zip(*table.values())]
    for arm in ARMS[: asked.arms or None]:
        key = (arm.surface, arm.name, str(arm.critic), str(arm.designs))
        seeds = {int(row["seed"]) for row in rows if tuple(row[name] for name in KEY) == key}
        surface = SURFACES[arm.surface]()
        for seed in sorted(set(range(asked.studies)) - seeds):
            found = asdict(study(arm, surface, seed))
            rows.append(
                {name: f"{value:.6g}" if isinstance(value, float) else str(value) for name, value in found.items()}
            )
        _write(file, rows)
        _write(asked.out / "summary.csv", summary(rows))
        print(*key, flush=True)


def _write(file: Path, rows: list[dict[str, str]]) -> None:
    with file.open("w", newline="") as table:
        writer = csv.DictWriter(table, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main(tyro.cli(Asked, prog="python -m benchmarks.choosing", description=__doc__))
