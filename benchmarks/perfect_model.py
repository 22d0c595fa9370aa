"""Would imagination help if the model made no error? Bodies chosen as by `grounded`, the simulator as the model.

``python -m benchmarks.perfect_model --out docs/results/perfect_model`` makes hopper runs of the protocol ``pilot`` that
imagine nothing, or what the simulator says of random bodies, or of the own body's states under fresh actions. A run
takes 5 to 7 minutes of one core; those that are whole in ``bodies.csv`` already are not made again. ``summary.csv``
has what each arm earned, and its difference to runs that imagine nothing; ``bodies.png`` draws it body by body.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any, Literal

import matplotlib.pyplot as plt
import pandas as pd
import torch
import tyro
from scipy.stats import ttest_1samp
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from benchmarks.appending import append_rows
from coim import CoAdaptation, DesignDone, HopperMorph, RandomDesigns
from coim.buffers import TransitionBuffer
from coim.experiments.drawing.curves import draw_mean
from coim.experiments.drawing.palette import BLACK, BLUE, ORANGE
from coim.experiments.frames import read_frame
from coim.experiments.report.summary_png import save
from coim.experiments.run.build import SIMULATED_ROWS, build
from coim.experiments.run.interrupt import locked, on_command_line
from coim.experiments.run.machine import prepare
from coim.experiments.run.settings import METHODS, Settings
from coim.experiments.statistics.intervals import mean, over_runs
from coim.experiments.study.definition import PROTOCOLS
from coim.tables import Layout

ArmName = Literal["none", "random", "own"]
PERFECT: dict[str, Any] = {"dream": "simulator", "individual_imagined_share": 0.2}
ARMS: dict[ArmName, dict[str, Any]] = {
    "none": {"imagine": "none"},
    # What `grounded-governed-both` imagines, by a model without error and ungoverned.
    "random": PERFECT | {"imagine": "random", "imagined_states": "matched"},
    # Which actions would have been better on this body: nothing of other bodies, and nothing for the population.
    "own": PERFECT | {"imagine": "known", "imagined_share": 0.0},
}
COLOURS: dict[ArmName, str] = {"none": BLUE, "random": BLACK, "own": ORANGE}
PILOT = dataclasses.replace(PROTOCOLS["pilot"], **METHODS["grounded"])
# Rows after each episode, of which batches draw 51 to 64 thousand times. A row for each would take 10 seconds more,
# and with a body of its own a minute: to build a body takes four times as long as to move it.
ROWS = 5_000
BODIES = Layout(
    file="bodies.csv",
    columns={"arm": str, "seed": int, "design": int, "kind": str, "best_return": float},
    needed=("arm", "seed", "design", "kind", "best_return"),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Comparison:
    """What is compared."""

    out: Path = Path("runs/perfect_model")
    """Folder for bodies.csv, summary.csv and bodies.png."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """A run of each arm for each of them."""
    arms: tuple[ArmName, ...] = ("none", "random", "own")
    """What is imagined."""
    sizes: Settings = PILOT
    """Settings of each run."""


class FewBodies(RandomDesigns):
    """Uniform designs, as many as the simulator has bodies, in turn: it builds nearly each of them once."""

    def __call__(self, design: Tensor, *, rng: torch.Generator | None = None) -> Tensor:
        """Return designs ``[N, *B, D]``: those of the first rows, over and over."""
        few = super().__call__(design[:SIMULATED_ROWS], rng=rng)
        return few.repeat(-(-len(design) // SIMULATED_ROWS), *[1] * (design.ndim - 1))[: len(design)]


def imagining(settings: Settings, *, own: bool) -> CoAdaptation:
    """Algorithm 1 that imagines `ROWS` rows after each episode.

    Args:
        settings: of the run.
        own: imagine from the states of the body at hand and by its own policy, not the population's.
    """
    algorithm = build(HopperMorph, settings)
    if (imagined := algorithm.imagined) is None:
        return algorithm
    if settings.imagine == "random":
        imagined.generator = FewBodies(algorithm.env.design_spec)
    whole = imagined.refresh

    def refresh(
        pop: TransitionBuffer, policy: TensorDictModuleBase, num_rows: int, **streams: torch.Generator | None
    ) -> dict[str, Tensor]:
        if own:
            pop, policy = algorithm.buffers.ind, algorithm.individual.policy
        return whole(pop, policy, min(num_rows, ROWS), **streams)

    imagined.refresh = refresh
    return algorithm


def main(comparison: Comparison) -> None:
    """Make the runs that are missing, then summarise everything.

    Raises:
        ValueError: if a run in the table has another number of bodies.
        BlockingIOError: if another process writes to the folder.
    """
    prepare(1, torch.device("cpu"))
    comparison.out.mkdir(parents=True, exist_ok=True)
    path = comparison.out / BODIES.file
    with locked(comparison.out):
        if not path.exists():
            append_rows(path, [BODIES.header()])
        done = whole_runs(path, comparison.sizes.num_designs)
        for seed, arm in product(comparison.seeds, comparison.arms):
            if (arm, seed) not in done:
                settings = dataclasses.replace(comparison.sizes, seed=seed, **ARMS[arm])
                found = [*bodies(imagining(settings, own=arm == "own"))]
                append_rows(path, [[arm, seed, *row] for row in found])
                print(f"{arm}, seed {seed}: {sum(float(row[-1]) for row in found) / len(found):.0f}", flush=True)
        rows = read_frame(path, BODIES)
        summary = summarise(rows)
        summary.to_csv(comparison.out / "summary.csv", index=False, float_format="%.5g", lineterminator="\n")
        print(summary.to_string(index=False, float_format="{:.0f}".format, formatters={"p": "{:.2g}".format}))
        draw(rows, comparison.out / "bodies.png")


def whole_runs(path: Path, num_designs: int) -> set[tuple[str, int]]:
    """Arms and seeds in the table.

    Raises:
        ValueError: if a run there is no run of so many bodies.
    """
    found = set()
    for (arm, seed), run in read_frame(path, BODIES).groupby(["arm", "seed"]):
        if sorted(run["design"]) != [*range(1, num_designs + 1)]:
            raise ValueError(
                f"{path} has {len(run)} rows of {arm} with seed {seed}, and a run has {num_designs} bodies; delete "
                "these rows, or name another folder with --out"
            )
        found.add((arm, seed))
    return found


def bodies(algorithm: CoAdaptation) -> Iterator[list]:
    """The bodies of a run: design, kind, best return."""
    for event in algorithm:
        if isinstance(event, DesignDone):
            yield [event.index + 1, event.kind, f"{float(event.best_return):.7g}"]


def summarise(rows: pd.DataFrame) -> pd.DataFrame:
    """Means over runs, and those of the differences to runs that imagine nothing, seed by seed.

    Args:
        rows: of ``bodies.csv``.

    Returns:
        Columns ``arm, measure, runs, mean, pairs, difference, low, high, p``: the mean of the arm's runs; and, of the
        seeds that both arms have, the difference with Student's 95 % interval and test. ``area``: mean best return of a
        run's bodies. ``final``: the highest. ``first``, ``optimised``, ``random``: the mean of such bodies.
    """
    runs = rows.groupby(["arm", "seed"])["best_return"].agg(area="mean", final="max")
    kinds = rows.pivot_table(index=["arm", "seed"], columns="kind", values="best_return")
    measured = runs.join(kinds)
    table: list[dict[str, object]] = []
    for arm in ARMS:
        if arm not in measured.index.levels[0]:
            continue
        for measure, values in measured.loc[arm].items():
            row: dict[str, object] = {"arm": arm, "measure": measure, "runs": values.count(), "mean": values.mean()}
            if arm != "none" and "none" in measured.index.levels[0]:
                row |= compared(values - measured.loc["none"][measure])
            table.append(row)
    return pd.DataFrame(table, columns=["arm", "measure", "runs", "mean", "pairs", "difference", "low", "high", "p"])


def compared(differences: pd.Series) -> dict[str, float]:
    """Mean of the differences of the seeds that both arms have, with its interval and the test that it is nothing."""
    paired = differences.dropna()
    row = {"pairs": len(paired), "difference": paired.mean()}
    if len(paired) < 2:
        return row
    test = ttest_1samp(paired, 0)
    low, high = test.confidence_interval()
    return row | {"low": float(low), "high": float(high), "p": float(test.pvalue)}


def draw(rows: pd.DataFrame, path: Path) -> None:
    """Mean best return of each body of a run, in the order of building, with its 95 % bootstrap interval."""
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    for arm, colour in COLOURS.items():
        found = rows[rows["arm"] == arm].pivot(index="seed", columns="design", values="best_return")
        if found.empty:
            continue
        value, low, high, _ = over_runs(found.to_numpy(), mean)
        band = {"low": low, "high": high} if len(found) > 1 else {}
        draw_mean(axes, found.columns.to_numpy(), value, **band, color=colour, label=f"{arm} ({len(found)} runs)")
    axes.set(xlabel="body", ylabel="best return, mean over runs")
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.legend(frameon=False, title="what is imagined, by the simulator")
    axes.spines[["top", "right"]].set_visible(False)
    save(figure, path)


if __name__ == "__main__":
    with on_command_line(own_process=True, again="the same command goes on with the next run"):
        main(tyro.cli(Comparison, prog="python -m benchmarks.perfect_model", description=__doc__))
