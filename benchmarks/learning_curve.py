"""Does it learn? One body that stays as drawn, the paper's sizes, with and without imagination, beside a random policy.

``python -m benchmarks.learning_curve`` trains the individual learner of Algorithm 1 on Half-Cheetah's unit body and
writes the evaluation returns of every episode and seed, the random policy's return, and a picture of both. With
``--arms model-free "model-free in bfloat16"`` it compares the precisions.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal

import matplotlib.pyplot as plt
import pandas as pd
import torch
import tyro

from benchmarks.appending import append_rows
from coim import EpisodeDone, HalfCheetahMorph, run_episode
from coim.experiments.frames import read_frame
from coim.experiments.report.summary_png import save
from coim.experiments.run.build import build
from coim.experiments.run.interrupt import on_command_line
from coim.experiments.run.machine import available_cores, checked_device, prepare
from coim.experiments.run.settings import Settings
from coim.tables import Layout

# Imagined rows in the individual batches too: on a single body the population's networks never act.
ARMS = {
    "model-free": Settings(imagine="none"),
    "known designs imagined": Settings(imagine="known", individual_imagined_share=0.2),
    "model-free in bfloat16": Settings(imagine="none", precision="bfloat16"),
}
COLOURS = dict(zip(ARMS, ("#0072B2", "#D55E00", "#009E73")))  # Okabe and Ito
CURVES = Layout(
    file="curves.csv",
    columns={"arm": str, "seed": int, "episode": int, "return": float},
    needed=("arm", "seed", "episode", "return"),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Curve:
    """Learning curves on Half-Cheetah's unit body."""

    out: Path = Path("runs/learning_curve")
    """Folder for curves.csv, summary.csv and curves.png; seeds that are in curves.csv already are not run again."""
    arms: tuple[Literal["model-free", "known designs imagined", "model-free in bfloat16"], ...] = (
        "model-free",
        "known designs imagined",
    )
    """What is compared."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """One run for each of them and each arm."""
    episodes: int = 25
    """Training episodes; an evaluation follows each."""
    random_episodes: int = 20
    """Episodes of the random policy."""


def main(curve: Curve) -> None:
    """Run what is missing, then draw everything."""
    curve.out.mkdir(parents=True, exist_ok=True)
    path = curve.out / CURVES.file
    if not path.exists():
        append_rows(path, [CURVES.header()])
    done = {*read(path)[["arm", "seed"]].itertuples(index=False, name=None)}
    for seed in curve.seeds:
        for arm in curve.arms:
            if (arm, seed) not in done:
                append_rows(path, returns(arm, dataclasses.replace(ARMS[arm], seed=seed), curve.episodes))
    if not (read(path)["arm"] == "random policy").any():
        append_rows(path, [["random policy", 0, i + 1, value] for i, value in enumerate(random_returns(curve))])
    summarise(curve, read(path))


def returns(arm: str, settings: Settings, episodes: int) -> list[list]:
    """Deterministic return after each training episode on the unit body."""
    threads = available_cores()
    side_by_side = prepare(threads, checked_device(settings.device))
    settings = dataclasses.replace(settings, num_designs=1, first_episodes=episodes)
    rows = []
    for event in build(HalfCheetahMorph, settings, threads=threads, side_by_side=side_by_side):
        if isinstance(event, EpisodeDone):
            rows.append([arm, settings.seed, event.episode + 1, f"{float(event.evaluation_return):.7g}"])
            print(*rows[-1], f"({event.seconds['episode']:.1f} s)", flush=True)
    if (left := episodes - len(rows)) > 0:
        print(f"{arm}, seed {settings.seed} diverged: its frozen policy's return stands for {left} episode(s)")
        rows += [[arm, settings.seed, episodes - left + i + 1, rows[-1][-1]] for i in range(left)]
    return rows


def random_returns(curve: Curve) -> list[float]:
    """Returns of uniformly random actions."""
    env, rng = HalfCheetahMorph(seed=0), torch.Generator().manual_seed(0)
    episodes = (run_episode(env, None, rng=rng) for _ in range(curve.random_episodes))
    return [float(rows["next", "reward"].sum()) for rows in episodes]


def summarise(curve: Curve, rows: pd.DataFrame) -> None:
    """Draw the curves and write the ratio to the random policy that each arm ends with."""
    by_random = rows["arm"] == "random policy"
    random_return = rows["return"][by_random].mean()
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    table = [
        ["arm", "seeds", "return_last_episode_mean", "return_last_episode_min", "times_random_mean", "times_random_min"]
    ]
    for arm, own in rows[~by_random].groupby("arm", sort=False):
        returns = own.pivot(index="episode", columns="seed", values="return").dropna()  # as far as all seeds have come
        axes.plot(returns, color=COLOURS[arm], linewidth=0.7, alpha=0.5)
        mean, count = returns.mean(axis="columns"), len(returns.columns)
        axes.plot(mean, color=COLOURS[arm], linewidth=2, label=f"{arm} ({count} seeds, mean)")
        last = returns.iloc[-1]
        numbers = last.mean(), last.min(), last.mean() / random_return, last.min() / random_return
        table.append([arm, count, *(f"{number:.4g}" for number in numbers)])
    axes.axhline(random_return, color="black", linestyle=":", label="random policy")
    axes.axhline(5 * random_return, color="black", linestyle="--", linewidth=0.8, label="5 x random policy")
    axes.set(xlabel="training episodes (1000 steps each)", ylabel="deterministic return")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    save(figure, curve.out / "curves.png")
    (curve.out / "summary.csv").unlink(missing_ok=True)
    append_rows(curve.out / "summary.csv", table)
    print(*(",".join(map(str, row)) for row in table), sep="\n")


def read(path: Path) -> pd.DataFrame:
    """Rows of ``curves.csv``."""
    return read_frame(path, CURVES)


if __name__ == "__main__":
    with on_command_line(own_process=True, again="the same command goes on with the next seed"):
        main(tyro.cli(Curve, prog="python -m benchmarks.learning_curve", description=__doc__))
