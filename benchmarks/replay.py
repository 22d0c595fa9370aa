"""Would the posterior have known? The preview study's runs replayed, body by body, with what was known at that time.

``python -m benchmarks.replay --out docs/results/choosing`` (35 s of one core) writes ``replay.csv``, a row for each
stored run and each body from the fourth on: what a posterior without a critic predicts for it, and what it earned.
Where a Hopper was chosen by Eq. 5, also which body the posterior would have chosen, and what the pooled surface says
of both.

Shapes: ``D`` design entries.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, stdev

import torch
import tyro
from scipy.stats import spearmanr
from torch import Tensor
from torchrl.data import Bounded

from benchmarks.choosing import WITHIN_90
from benchmarks.surfaces import Tried, pooled, stored
from coim import HalfCheetahMorph, HopperMorph
from coim.designs import DesignPosterior, GradientSearch
from coim.designs.search import Fitness

COLUMNS = (
    "run",
    "design",
    "kind",
    "predicted",
    "deviation",
    "best_return",
    "eq5_gain",
    "posterior_gain",
    "would_choose",
)


@dataclass(frozen=True)
class Asked:
    """Replay the stored runs.

    Attributes:
        out: folder of the table.
        runs: of each environment, only the first so many; 0: all.
    """

    out: Path
    runs: int = 0


def main(asked: Asked) -> None:
    """Replay, write, and print the means."""
    torch.set_num_threads(1)
    rows: list[dict[str, str | float]] = []
    for environment, body in (("hopper", HopperMorph), ("half_cheetah", HalfCheetahMorph)):
        spec, tried = body(seed=0).design_spec, stored(environment)
        runs = sorted({one.run for one in tried})
        for run in runs[: asked.runs or None]:
            gain = gain_on_other_seeds(tried, run) if environment == "hopper" else None
            rows += replayed(spec, [one for one in tried if one.run == run], gain)
    asked.out.mkdir(parents=True, exist_ok=True)
    with (asked.out / "replay.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        table.writeheader()
        for row in rows:
            table.writerow({name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()})
    for line in told(rows):
        print(line)


def gain_on_other_seeds(tried: list[Tried], run: str) -> Fitness:
    """Expected return over that of a uniform body, by a surface that knows no run of the same seed.

    Arms of one seed have random bodies in common.
    """
    seed = run.rpartition("-")[2]
    surface = pooled([one for one in tried if one.run.rpartition("-")[2] != seed])
    level = surface.truth(surface.box()).mean()
    return lambda designs: surface.truth(designs) - level


def replayed(spec: Bounded, run: list[Tried], gain: Fitness | None) -> Iterator[dict[str, str | float]]:
    """A row for each body of a run from the fourth on."""
    for n in range(3, len(run)):
        known = run[:n]
        designs = torch.stack([one.design for one in known])
        posterior = DesignPosterior(spec, designs, torch.tensor([one.returned for one in known]))
        mean, deviation = posterior.predict(run[n].design[None])
        row: dict[str, str | float] = {"run": run[n].run, "design": str(run[n].number), "kind": run[n].kind}
        row |= {"predicted": mean.item(), "deviation": deviation.item(), "best_return": run[n].returned}
        if run[n].kind == "optimised" and gain is not None:
            chosen, _ = GradientSearch(spec, seed=n).maximise(posterior)
            row |= {"eq5_gain": gain(run[n].design[None]).item(), "posterior_gain": gain(chosen[None]).item()}
            row["would_choose"] = _words(chosen)
        yield row


def told(rows: list[dict[str, str | float]]) -> Iterator[str]:
    """Coverage by environment and kind, rank correlation within a run, and what both choices are worth."""
    for environment in ("hopper", "half_cheetah"):
        own = [row for row in rows if str(row["run"]).startswith(environment)]
        for kind in ("first", "optimised", "random"):
            some = [row for row in own if row["kind"] == kind]
            inside = [
                abs(float(row["best_return"]) - float(row["predicted"])) < WITHIN_90 * float(row["deviation"])
                for row in some
            ]
            yield f"{environment}, {kind}: {mean(inside):.2f} of {len(some)} returns within the 90 % interval"
        ranks = []
        for run in sorted({row["run"] for row in own}):
            later = [row for row in own if row["run"] == run and row["kind"] != "first"]
            pairs = [[float(row[name]) for row in later] for name in ("predicted", "best_return")]
            ranks.append(float(spearmanr(*pairs).statistic))
        yield f"{environment}: rank correlation {mean(ranks):.2f} within a run, {len(ranks)} runs"
    for name in ("eq5_gain", "posterior_gain"):
        gains = [float(row[name]) for row in rows if name in row]
        runs = len({row["run"] for row in rows if name in row})
        yield f"{name}: {mean(gains):.0f}, deviation {stdev(gains):.0f}, {len(gains)} bodies of {runs} runs"


def _words(design: Tensor) -> str:
    return " ".join(f"{entry:.2f}" for entry in design.tolist())


if __name__ == "__main__":
    main(tyro.cli(Asked, prog="python -m benchmarks.replay", description=__doc__))
