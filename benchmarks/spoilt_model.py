"""Does imagination by a spoilt model harm learning, and does the governor prevent it?

``python -m benchmarks.spoilt_model --out docs/results/spoilt_model`` trains hoppers on the same bodies without
imagination, and with a model that is spoilt whenever it is asked: its weights are drawn anew after everything that it
learns, or its predictions are off by one standard deviation of a step's change. With each of both it imagines as asked,
and governed. A seed is five runs in lock-step; seeds that are in ``curves.csv`` already are not run again.
``summary.csv`` has the mean return of each arm with its interval, and whether it lies within that of the baseline.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from benchmarks.appending import append_rows
from coim import CoAdaptation, DynamicsLearner, EpisodeDone, HopperMorph
from coim.experiments.drawing.curves import draw_mean
from coim.experiments.drawing.palette import BLACK, BLUE, VERMILION, Dashes
from coim.experiments.frames import read_frame
from coim.experiments.report.summary_png import save
from coim.experiments.run.build import build
from coim.experiments.run.interrupt import on_command_line
from coim.experiments.run.machine import prepare
from coim.experiments.run.settings import Settings
from coim.experiments.statistics.intervals import interval, mean, over_runs
from coim.tables import Layout

Spoilt = Literal["nothing", "weights drawn anew", "off by one deviation"]
NONE = "no imagination"
# Half of the batches of both learners is imagined, as random bodies: the paper's fifth in the population's batches
# alone reaches the controller of a body only through the weights that it starts from. Networks, updates and episodes
# are those of the protocol "pilot", in which the two bodies earn 630 and 1,000 on the mean without imagination.
SIZES = Settings(
    num_runs=5,
    num_designs=2,
    first_episodes=6,
    num_cells=(64, 64, 64),
    model_cells=(200, 200, 200),
    compile=True,
    imagine="random",
    imagined_share=0.5,
    individual_imagined_share=0.5,
)
CURVES = Layout(
    file="curves.csv",
    columns={
        "arm": str,
        "seed": int,
        "run": int,
        "design": int,
        "episode": int,
        "env_steps": int,
        "return": float,
        "model_error": float,
        "imagined_share": float,
    },
    needed=("arm", "seed", "run", "design", "episode", "env_steps", "return"),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arm:
    """What is imagined.

    Attributes:
        settings: those that differ from the sizes.
        spoilt: how the model is spoilt.
        colour: of its curve.
        dashes: of its curve.
    """

    settings: dict[str, object]
    spoilt: Spoilt
    colour: str
    dashes: Dashes


ARMS = {
    NONE: Arm(
        settings={"imagine": "none", "individual_imagined_share": 0.0}, spoilt="nothing", colour=BLACK, dashes="-"
    ),
    "drawn anew": Arm(settings={}, spoilt="weights drawn anew", colour=VERMILION, dashes="-"),
    "drawn anew, governed": Arm(
        settings={"governed": True}, spoilt="weights drawn anew", colour=VERMILION, dashes=(0, (1, 3))
    ),
    "off by one": Arm(settings={}, spoilt="off by one deviation", colour=BLUE, dashes="-"),
    "off by one, governed": Arm(
        settings={"governed": True}, spoilt="off by one deviation", colour=BLUE, dashes=(2, (1, 3))
    ),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Comparison:
    """What is compared."""

    out: Path = Path("runs/spoilt_model")
    """Folder for curves.csv, summary.csv and curves.png."""
    seeds: tuple[int, ...] = (0, 1)
    """Five runs of each arm for each of them."""
    sizes: Settings = SIZES
    """Settings of each run."""


class SpoiltModel:
    """Lets a learner learn as ever, while whoever asks its ensemble asks a spoilt one.

    Args:
        learner: of the ensemble; its ``update`` is replaced.
        how: its weights are drawn anew after every call of ``update``, or the bias of its means is one standard
            deviation of a step's change too high outside of it.
        seed: of the weights.
    """

    def __init__(self, learner: DynamicsLearner, how: Spoilt, *, seed: int) -> None:
        self.network, self.how = learner.ensemble.network, how
        self._rng, self._update = torch.Generator().manual_seed(seed), learner.update
        if how == "off by one deviation":
            self._shift(1.0)
        setattr(learner, "update", self.update)  # noqa: B010

    def update(self, batches: TensorDictBase) -> TensorDict:
        """Learn from batches with the sound weights, and spoil them again."""
        if self.how == "off by one deviation":
            self._shift(-1.0)
        found = self._update(batches)
        if self.how == "off by one deviation":
            self._shift(1.0)
        else:
            self.network.reset_parameters(self._rng)
        return found

    @torch.no_grad()
    def _shift(self, deviations: float) -> None:
        bias = self.network.layers[-1].bias  # of the standardised change's mean, then of its log-variance
        assert isinstance(bias, Tensor)
        bias[..., : bias.shape[-1] // 2] += deviations


def main(comparison: Comparison) -> None:
    """Run what is missing, then summarise and draw everything."""
    prepare(1, torch.device("cpu"))
    comparison.out.mkdir(parents=True, exist_ok=True)
    path = comparison.out / CURVES.file
    if not path.exists():
        append_rows(path, [CURVES.header()])
    done = {*read_frame(path, CURVES)[["arm", "seed"]].itertuples(index=False, name=None)}
    for seed in comparison.seeds:
        for name, arm in ARMS.items():
            if (name, seed) not in done:
                settings = dataclasses.replace(comparison.sizes, seed=seed, **arm.settings)
                append_rows(path, [*returns(name, settings, arm.spoilt)])
    rows = read_frame(path, CURVES)
    summary = summarise(rows)
    summary.to_csv(comparison.out / "summary.csv", index=False, float_format="%.5g", lineterminator="\n")
    print(summary.to_string(index=False, float_format="{:.0f}".format))
    draw(rows, comparison.out / "curves.png")


def returns(name: str, settings: Settings, spoilt: Spoilt) -> Iterator[list]:
    """Rows of ``curves.csv``: the deterministic return after each training episode of each run."""
    algorithm: CoAdaptation = build(HopperMorph, settings)
    if algorithm.dynamics is not None:
        SpoiltModel(algorithm.dynamics, spoilt, seed=settings.seed)
    for event in algorithm:
        if isinstance(event, EpisodeDone):
            nothing = torch.full((settings.num_runs,), torch.nan)
            error, share = (event.metrics.get(column, nothing) for column in ("model_error", "imagined_share"))
            for run, value in enumerate(event.evaluation_return.tolist()):
                place = [name, settings.seed, run, event.index + 1, event.episode + 1, event.env_steps]
                numbers = (value, float(error[run]), float(share[run]))
                yield [*place, *("" if np.isnan(number) else f"{number:.7g}" for number in numbers)]
            print(name, settings.seed, event.env_steps, f"{float(event.evaluation_return.mean()):.0f}", flush=True)


def summarise(rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each arm: its mean return over all episodes, and the difference to the baseline, run by run."""
    means = rows.groupby(["arm", "seed", "run"])["return"].mean()
    baseline = means[NONE]
    low, high = ends(baseline)
    table = []
    for name in ARMS:
        if name not in means:
            continue
        own = means[name]
        difference = (own - baseline).dropna()
        share = rows["imagined_share"][rows["arm"] == name]
        table.append(
            {"arm": name, "runs": len(own), "mean_return": own.mean()}
            | dict(zip(("low", "high"), ends(own)))
            | {"difference": difference.mean()}
            | dict(zip(("difference_low", "difference_high"), ends(difference)))
            | {"within_baseline": "yes" if low <= own.mean() <= high else "no"}
            | {"same_as_baseline": int((difference == 0).sum()), "largest_share": share.max()}
        )
    return pd.DataFrame(table)


def ends(values: pd.Series) -> tuple[float, float]:
    """95 % bootstrap interval of a mean over runs; NaN for one run."""
    low, high = interval(mean, values.to_numpy())
    return float(low), float(high)


def draw(rows: pd.DataFrame, path: Path) -> None:
    """Mean return over training steps of each arm, the baseline with its interval."""
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    for name, arm in ARMS.items():
        own = rows[rows["arm"] == name]
        if own.empty:
            continue
        found = own.pivot(index=["seed", "run"], columns="env_steps", values="return")
        value, low, high, _ = over_runs(found.to_numpy(), mean)
        band = {"low": low, "high": high} if name == NONE and len(found) > 1 else {}
        style = {"color": arm.colour, "linestyle": arm.dashes, "linewidth": 2.6 if "governed" in name else 1.4}
        draw_mean(axes, found.columns.to_numpy(), value, **band, **style, label=name)
    axes.set(xlabel="training steps of one run", ylabel="deterministic return, mean over runs")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    save(figure, path)


if __name__ == "__main__":
    with on_command_line(own_process=True, again="the same command goes on with the next arm and seed"):
        main(tyro.cli(Comparison, prog="python -m benchmarks.spoilt_model", description=__doc__))
