"""A yardstick for bodies: one policy for all of them, and what it earns on each.

A policy that learns on another random body in every episode, none of which is better known to it than another, walks on
thousands of bodies and on those that a study has tried. So bodies of different runs are measured alike, apart from the
luck of a run. It says what a body is worth to this policy, not to one that is trained for the body; how well the two
agree is measured too: by the study's returns and by bodies that were trained from scratch. ::

    coim run hopper --imagine none --bodies random --num-designs 1000 --first-episodes 1 --episodes 1 \\
        --individual-updates 0 --population-updates 1000 --num-cells 64 64 64 --checkpoint-every 20 --out runs/universal
    python -m benchmarks.yardstick runs/universal

writes ``bodies.csv``, every body with what it earned, and ``summary.csv``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd
import torch
import tyro
from scipy.stats import ttest_1samp
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from benchmarks.surfaces import uniform
from coim import MorphEnv, load_run, run_episode
from coim.envs.native_episode import can_be_native
from coim.experiments.frames import read_frame, spearman, spearman_given
from coim.experiments.run.interrupt import on_command_line
from coim.experiments.run.machine import prepare
from coim.experiments.run.provenance import git_revision
from coim.experiments.statistics.retrained import results
from coim.experiments.study.runs import CHOSEN
from coim.run_folder import DESIGNS
from coim.tables import DESIGN_PREFIX, design_columns

STUDY = Path(__file__).parents[1] / "docs/results/bodies"
AT_ONCE = 100  # bodies in a fleet


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measured:
    """What is measured."""

    run: tyro.conf.Positional[Path]
    """Folder of the run whose population's policy is the yardstick."""
    study: Path = STUDY
    """Archive of a study of the same body, whose bodies are measured."""
    out: Path = Path("runs/yardstick")
    """Folder of the tables."""
    num_bodies: int = 2000
    """Uniform bodies."""
    episodes: int = 2
    """Episodes on each body, from different starts."""


def main(asked: Measured) -> None:
    """Measure, print and write."""
    prepare(1, torch.device("cpu"))
    saved = load_run(asked.run)
    if saved.bodies.batch_size.numel() > 1:
        raise ValueError(
            f"{asked.run} has {saved.bodies.batch_size.numel()} policies, a yardstick is one: --num-runs 1"
        )
    anywhere = uniform(saved.bodies.design_spec, asked.num_bodies, torch.Generator().manual_seed(0))
    columns = design_columns(saved.bodies.design_names())
    uniform_ones = pd.DataFrame(anywhere.numpy(), columns=columns).assign(arm="uniform", kind="uniform")
    bodies = pd.concat([uniform_ones, tried(asked.study, saved.environment)], ignore_index=True)
    designs = torch.tensor(bodies.filter(like=DESIGN_PREFIX).to_numpy(), dtype=torch.float32)
    bodies["earned"] = earned(saved.bodies, saved.population.policy, designs, asked.episodes)
    asked.out.mkdir(parents=True, exist_ok=True)
    bodies.to_csv(asked.out / "bodies.csv", index=False, float_format="%.6g", lineterminator="\n")
    found = summary(bodies)
    found["revision"], found["episodes_learnt"] = git_revision(), len(saved.designs)
    found.to_csv(asked.out / "summary.csv", index=False, float_format="%.4g", lineterminator="\n")
    print(found.drop(columns=["revision", "episodes_learnt"]).to_string(index=False, float_format="%.3g"))


def tried(study: Path, environment: str) -> pd.DataFrame:
    """Every body of a study's runs with its best return there, and the bodies that were trained from scratch."""
    found = []
    for folder in sorted((study / "cells").glob(f"{environment}-forward-*")):
        arm, seed = folder.name.removeprefix(f"{environment}-forward-").rsplit("-", 1)
        table = read_frame(folder / DESIGNS.file, DESIGNS)
        found.append(table.assign(arm=arm, seed=int(seed))[table["run"] == 0])
    if not found:
        raise ValueError(f"{study} has no run of {environment}; name a study of that body with --study")
    bodies = pd.concat(found).drop(columns=["run", "predicted", "diverged"], errors="ignore")
    listed = study / "retrained" / CHOSEN.file
    if listed.exists():
        retrained, _ = results(listed.parent, read_frame(listed, CHOSEN).query("environment == @environment"))
        at = retrained.set_index(["arm", "seed", "design"])["best_return"].rename("retrained")
        bodies = bodies.join(at, on=["arm", "seed", "design"])
    return bodies


def earned(like: MorphEnv, policy: TensorDictModuleBase, designs: Tensor, episodes: int) -> list[float]:
    """Mean return of the mode of a policy on each body ``[P, D]``."""
    found: list[Tensor] = []
    for part in designs.split(AT_ONCE):
        fleet = type(like)(num_runs=len(part), task=like.task, episode_steps=like.episode_steps, seed=0)
        rows = [
            run_episode(fleet, policy, design=part, deterministic=True, native=can_be_native())["next", "reward"]
            for _ in range(episodes)
        ]
        found.append(torch.stack(rows).sum(1).mean(0).squeeze(-1))
    return torch.cat(found).tolist()


def summary(bodies: pd.DataFrame) -> pd.DataFrame:
    """What each arm has found by the yardstick, mean over runs with Student's 95 % interval, and how far it agrees.

    Args:
        bodies: with ``arm``, ``seed``, ``design``, ``kind``, ``best_return``, perhaps ``retrained``, and ``earned``.

    Returns:
        Columns ``arm, measure, mean, low, high, runs``. ``best``: the body with a run's best return. ``first``,
        ``optimised``, ``random``: the mean of such bodies. ``regret``: the best uniform body less ``best``.
        ``rank_correlation``: of what is earned with a run's best returns, the order of building held fixed.
        ``retrained``: the rank correlation with returns from scratch, over all runs.
    """
    anywhere = bodies[bodies["arm"] == "uniform"]["earned"]
    rows: list[dict[str, object]] = []

    def add(arm: str, measure: str, values: Iterable[float]) -> None:
        numbers = [value for value in values if np.isfinite(value)]
        row = {"arm": arm, "measure": measure, "mean": np.mean(numbers) if numbers else np.nan, "runs": len(numbers)}
        if len(numbers) > 1:
            row["low"], row["high"] = ttest_1samp(numbers, 0).confidence_interval()
        rows.append(row)

    places = {"mean": anywhere.mean(), "ninth_decile": anywhere.quantile(0.9), "best": anywhere.max()}
    rows += [{"arm": "uniform", "measure": name, "mean": at, "runs": len(anywhere)} for name, at in places.items()]
    for arm, own in bodies[bodies["arm"] != "uniform"].groupby("arm", sort=False):
        runs = [run for _, run in own.groupby("seed")]
        best = [run.loc[run["best_return"].idxmax(), "earned"] for run in runs]
        add(str(arm), "best", best)
        add(str(arm), "regret", [anywhere.max() - value for value in best])
        for kind in ("first", "optimised", "random"):
            if (own["kind"] == kind).any():
                add(str(arm), kind, [run[run["kind"] == kind]["earned"].mean() for run in runs])
        later = [run[run["kind"] != "first"] for run in runs]
        add(str(arm), "rank_correlation", map(agreement, later))
    if "retrained" in bodies:
        known = bodies.dropna(subset=["retrained"])
        correlation = spearman(known["earned"], known["retrained"])
        rows.append({"arm": "all", "measure": "retrained", "mean": correlation, "runs": len(known)})
    return pd.DataFrame(rows, columns=["arm", "measure", "mean", "low", "high", "runs"])


def agreement(run: pd.DataFrame) -> float:
    """Rank correlation of what bodies earn and their best returns in a run, the order of building held fixed."""
    return spearman_given(run["earned"], run["best_return"], given=run["design"])


if __name__ == "__main__":
    with on_command_line(own_process=True):
        main(tyro.cli(Measured, description=__doc__))
