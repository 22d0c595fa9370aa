"""How far imagined rows are from what the simulator does: as printed, with matched states, and anchored.

``python -m benchmarks.imagined_rows --out docs/results/imagined_rows`` (half an hour on one core) lets the policy of
``benchmarks/data/hopper.pt`` walk an episode on each body that it was trained on, and an ensemble of the paper's sizes
learn from these episodes one after the other, as in Algorithm 1. ``foreseen.csv`` says how well it foresaw each body's
first episode before it learnt from it, beside spoilt copies of it; ``rows.csv`` how far the rows of `coim.imagine` are
from the simulator set to the same states and bodies, in the end; ``floor.csv`` how deep bodies get into the floor.
"""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import torch
import tyro
from tensordict import TensorDict
from torch import Tensor

from benchmarks.networks import FOLDER, load
from coim import (
    DesignGenerator,
    DynamicsLearner,
    GaussianEnsemble,
    KnownDesigns,
    MorphEnv,
    NoisyDesigns,
    RandomDesigns,
    SimulatorDynamics,
    TransitionBuffer,
    WorldModelEnv,
    imagine,
    run_episode,
    sample_batches,
)
from coim.envs import BODIES
from coim.experiments.run.interrupt import on_command_line
from coim.experiments.run.machine import prepare
from coim.pairs import IN_THE_FLOOR, impossible_pairs

SIMULATED = 250  # bodies that the simulator sets up at once
AS_PRINTED: dict[str, Any] = {}
MATCHED: dict[str, Any] = {"states_are": "matched"}
ANCHORED: dict[str, Any] = {"states_are": "matched", "anchored": True}
WAYS = {"as printed": AS_PRINTED, "matched": MATCHED, "matched, anchored": ANCHORED}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measurement:
    """What is learnt and asked."""

    out: Path = Path("runs/imagined_rows")
    """Folder for the CSV files."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """One ensemble for each of them."""
    designs: int = 1000
    """At most so many bodies are learnt from."""
    updates: int = 250
    """Updates of the ensemble after each episode."""
    rows: int = 5000
    """Rows that are imagined of each kind."""
    episode_steps: int = 1000
    """Steps of an episode."""
    model_cells: tuple[int, ...] = (500, 500, 500)
    """Hidden units of each member."""
    num_bodies: int = 50
    """Uniform bodies of each kind whose depth in the floor is measured."""


class MeanOfMembers:
    """The mean of the members' means in the place of one member: what an ensemble knows, without what TS1 draws."""

    def __init__(self, ensemble: GaussianEnsemble) -> None:
        self.ensemble = ensemble

    def sample(self, observation: Tensor, action: Tensor, design: Tensor, *, generator: Any = None) -> Tensor:
        """The mean, ``[*B, S]``, averaged as changes: the mean of two angles beside the cut at pi is beyond it."""
        means, _ = self.ensemble.moments(observation, action, design)
        change = self.ensemble.wrapped(means - observation.unsqueeze(-2)).mean(-2)
        return self.ensemble.wrapped(observation + change)

    def means(self, *asked: tuple[Tensor, Tensor, Tensor], generator: Any = None) -> tuple[Tensor, ...]:
        """The mean for each of several questions."""
        return tuple(self.sample(*one) for one in asked)


def main(measurement: Measurement) -> None:
    """Measure and write."""
    prepare(1, torch.device("cpu"))
    measurement.out.mkdir(parents=True, exist_ok=True)
    env, policy, _, starts = load("hopper")
    designs = torch.unique(starts["design"], dim=0)
    rows: list[dict[str, Any]] = []
    foreseen: list[dict[str, Any]] = []
    for seed in measurement.seeds:
        rng = torch.Generator().manual_seed(seed)
        order = designs[torch.randperm(len(designs), generator=rng)][: measurement.designs]
        fleet = type(env)(num_runs=len(order), episode_steps=measurement.episode_steps, seed=seed)
        episodes = [run_episode(fleet, policy, design=order, rng=rng) for _ in range(2)]
        learner = new_learner(env, measurement, seed)
        foreseen += [{"seed": seed} | row for row in learn(learner, episodes[0], measurement, seed)]
        write(measurement.out / "foreseen.csv", foreseen)
        kept = episodes[1].flatten()[torch.randperm(episodes[1].numel(), generator=rng)[: measurement.rows]]
        rows += [{"seed": seed} | row for row in compare(env, policy, learner.ensemble, kept, seed)]
        write(measurement.out / "rows.csv", rows)
        print(f"seed {seed} is done", flush=True)
    write(measurement.out / "floor.csv", depths(measurement))


def new_learner(env: MorphEnv, measurement: Measurement, seed: int) -> DynamicsLearner:
    """An ensemble that has seen nothing."""
    torch.manual_seed(seed)
    return DynamicsLearner(GaussianEnsemble.for_env(env, num_cells=measurement.model_cells))


def learn(
    learner: DynamicsLearner, episodes: TensorDict, measurement: Measurement, seed: int
) -> Iterator[dict[str, Any]]:
    """Learn body after body from ``[T, bodies]``; says how well each was foreseen, by the model and by spoilt ones."""
    buffer = TransitionBuffer(episodes.numel(), seed=seed)
    for body in range(episodes.shape[1]):
        rows = episodes[:, body : body + 1].exclude("index")
        learner.observe(rows[:, 0])
        models = {"learnt": learner, "weights drawn anew": drawn_anew(learner), "off by one deviation": off(learner)}
        yield {"body": body + 1} | {name: float(model.error(rows[:, 0])) for name, model in models.items()}
        buffer.extend(rows)
        for _ in range(0, measurement.updates, 50):
            learner.update(sample_batches(buffer, num_batches=min(50, measurement.updates))[:, :, 0])


def copied(learner: DynamicsLearner) -> DynamicsLearner:
    """A learner of a copy of the ensemble."""
    return DynamicsLearner(deepcopy(learner.ensemble))


def drawn_anew(learner: DynamicsLearner) -> DynamicsLearner:
    """The ensemble with weights that have learnt nothing, and all that it knows of scales."""
    spoilt = copied(learner)
    spoilt.ensemble.network.reset_parameters(torch.Generator().manual_seed(0))
    return spoilt


def off(learner: DynamicsLearner) -> DynamicsLearner:
    """The ensemble with predictions that are all one standard deviation of a step's change too high."""
    spoilt = copied(learner)
    bias = spoilt.ensemble.network.layers[-1].bias
    assert isinstance(bias, Tensor)
    with torch.no_grad():
        bias[..., : bias.shape[-1] // 2] += 1.0
    return spoilt


@torch.no_grad()
def compare(env: MorphEnv, policy: Any, ensemble: GaussianEnsemble, real: TensorDict, seed: int) -> list[dict]:
    """Imagine from real transitions ``[N]`` in every way, and set the simulator to the same states and bodies."""
    truth = SimulatorDynamics(type(env)(num_runs=SIMULATED, seed=0))
    spec, variance = env.design_spec, ensemble.targets.std.square().float()
    generators: dict[str, DesignGenerator] = {
        "known": KnownDesigns(),
        "noisy": NoisyDesigns(spec, sigma=0.1),
        "random": RandomDesigns(spec),
    }
    dreams = {
        "drawn": WorldModelEnv(ensemble, env, batch_size=[1]),
        "mean": WorldModelEnv(MeanOfMembers(ensemble), env, batch_size=[1]),
    }
    seen_rows = real["observation"], real["action"], real["design"]
    limit = ensemble.disagreement(*seen_rows).quantile(0.95)
    found: list[dict] = []
    for actions in ("replayed", "fresh"):
        for designs, generator in generators.items():
            for way, how in WAYS.items():
                row: dict[str, Any] = {"designs": designs, "way": way, "actions": actions}
                for name, dream in dreams.items():
                    rng = torch.Generator().manual_seed(seed)
                    rows = imagine(dream, real, policy, generator, **how, actions=actions, rng=rng)
                    asked = rows["observation"], rows["action"], rows["design"]
                    after = truth.sample(*asked)
                    error = mean_square(ensemble, rows["next", "observation"] - after, variance)
                    row |= {
                        name: error,
                        f"{name}_unexplained": error / mean_square(ensemble, asked[0] - after, variance),
                    }
                    agreed = ensemble.disagreement(*asked) <= limit
                    row[f"{name}_agreed"] = mean_square(
                        ensemble, (rows["next", "observation"] - after)[agreed], variance
                    )
                row["agreed"] = float(agreed.float().mean())
                row["impossible"] = float(impossible_pairs(env.clearance, asked[0], asked[2]).float().mean())
                found.append(row)
    seen = {row["actions"]: row for row in found if (row["designs"], row["way"]) == ("known", "as printed")}
    for row in found:
        for name in dreams:
            column = f"{name}_unexplained"
            row[f"{name}_of_seen"] = row[column] / seen[row["actions"]][column]
    return found


def mean_square(ensemble: GaussianEnsemble, error: Tensor, variance: Tensor) -> float:
    """Mean squared error in variances of one-step changes, angles wrapped."""
    return float((ensemble.wrapped(error).square() / variance).mean())


def depths(measurement: Measurement) -> list[dict[str, Any]]:
    """Quantiles of how deep uniform bodies of each kind are in the floor in an episode, in m."""
    found = []
    for name, body in BODIES.items():
        fleet = body(num_runs=measurement.num_bodies, episode_steps=measurement.episode_steps, seed=0)
        rng = torch.Generator().manual_seed(0)
        designs = RandomDesigns(fleet.design_spec)(torch.ones(measurement.num_bodies, body.DESIGN_SIZE), rng=rng)
        policies = {"random actions": None} | (
            {"trained policy": load(name)[1]} if (FOLDER / f"{name}.pt").exists() else {}
        )
        for told, policy in policies.items():
            rows = run_episode(fleet, policy, design=designs, rng=rng)
            depth = (-fleet.clearance(rows["observation"], rows["design"])).clamp(min=0).flatten()
            row: dict[str, Any] = {"body": name, "actions": told}
            for share in (0.5, 0.9, 0.99, 0.999):
                row[f"quantile_{share}"] = float(depth.double().quantile(share))
            found.append(
                row | {"deepest": float(depth.max()), "impossible": float((depth > IN_THE_FLOOR).float().mean())}
            )
    return found


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    """One CSV file, four digits."""
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, rows[0], lineterminator="\n")
        table.writeheader()
        table.writerows({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)


if __name__ == "__main__":
    with on_command_line(own_process=True):
        main(tyro.cli(Measurement, description=__doc__))
