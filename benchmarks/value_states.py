"""Does Eq. 5 rank bodies? By the states that it averages over, stored as they are or put under each candidate.

``python -m benchmarks.value_states`` (half a minute) asks the networks of ``benchmarks/data/hopper.pt`` about the 300
Hopper bodies of the preview study, and writes Spearman's correlation with the best returns on them: mean, least and
largest over draws of states.
"""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path
from statistics import mean
from typing import Any

import torch
import tyro
from scipy.stats import spearmanr
from tensordict import TensorDict
from torch import Tensor

from benchmarks.networks import load
from coim import DesignValue, MorphEnv, Policy, run_episode
from coim.experiments.run.interrupt import on_command_line
from coim.experiments.run.machine import prepare
from coim.run_folder import read_designs

CELLS = Path(__file__).parents[1] / "docs/results/preview/cells"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Asked:
    """What is asked."""

    out: Path = Path("runs/value_states.csv")
    """Where the table goes."""
    draws: int = 10
    """Draws of states."""
    num_states: tuple[int, ...] = (36, 128)
    """States that are averaged over."""
    episode_steps: int = 1000
    """Steps of the episodes whose states are visited."""


def main(asked: Asked) -> None:
    """Ask, print and write."""
    prepare(1, torch.device("cpu"))
    env, policy, qvalue, starts = load("hopper")
    designs, returns = tried_bodies()
    sources = {"start": starts, "visited": visited(env, policy, starts, asked.episode_steps)}
    rows: list[dict[str, Any]] = []
    for num_states in asked.num_states:
        for over, source in sources.items():
            for how in ("stored", "matched"):
                found = []
                for seed in range(asked.draws):
                    rng = torch.Generator().manual_seed(seed)
                    states = source[torch.randint(len(source), (num_states,), generator=rng)]
                    value = DesignValue(policy, qvalue, states, start_states_are=how, env=env)
                    found.append(float(spearmanr(value(designs), returns).statistic))
                numbers = {"correlation": mean(found), "least": min(found), "largest": max(found)}
                row = {"over": over, "states": how, "num_states": num_states}
                rows.append(row | {name: f"{number:.3f}" for name, number in numbers.items()})
                print(*rows[-1].values(), flush=True)
    asked.out.parent.mkdir(parents=True, exist_ok=True)
    with asked.out.open("w", newline="") as file:
        table = csv.DictWriter(file, rows[0], lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def tried_bodies() -> tuple[Tensor, Tensor]:
    """Designs ``[300, 4]`` of the preview study's Hopper runs and the best return on each."""
    tried = [design for path in sorted(CELLS.glob("hopper-*")) for design in read_designs(path)]
    return torch.stack([design.design for design in tried]), torch.tensor([design.best_return for design in tried])


def visited(env: MorphEnv, policy: Policy, starts: TensorDict, steps: int) -> TensorDict:
    """States of an episode of the policy on each body that the networks were trained on, ``[N]``."""
    bodies = torch.unique(starts["design"], dim=0)
    fleet = type(env)(num_runs=len(bodies), episode_steps=steps, seed=0)
    rows = run_episode(fleet, policy, design=bodies, rng=torch.Generator().manual_seed(0))
    return rows.select("observation", "design").flatten()


if __name__ == "__main__":
    with on_command_line(own_process=True):
        main(tyro.cli(Asked, description=__doc__))
