"""Episodes of a policy on its body, and their returns.

Shapes: E episodes, T steps, D design.
"""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import torch

from coim.episode import run_episode
from coim.experiments.export.taken import Taken
from coim.experiments.frames import rows_of
from coim.experiments.run.atomic_write import as_csv, naming_out, readable, shortest, write_whole
from coim.experiments.run.records import number
from coim.tables import DESIGN_PREFIX, Layout, design_columns

EVALUATION = Layout(
    file="evaluation.csv",
    columns={
        "source": str,
        "policy": str,
        "run": float,
        "seed": float,  # has no cells in tables of earlier versions, nor has `broken`
        "episode": int,
        "return": float,
        "broken": float,
        DESIGN_PREFIX: float,
    },
    needed=("episode", "return"),
)


def evaluate(taken: Taken, *, episodes: int, seed: int) -> pd.DataFrame:
    """Run the deterministic policy, with another start for each episode.

    Args:
        taken: policy and body.
        episodes: E, all in lock-step.
        seed: of the starts.

    Returns:
        A row for each episode: the folder or file that was named, whose policy acted (``best`` or ``population``; a
        file does not say), of which of K runs, the seed of the starts, the episode's number from 1, its return, how
        often the simulation broke and began again, and the design. So rows of several evaluations can stand in one
        table.
    """
    torch.set_num_threads(1)  # as in training: another number could round otherwise
    bodies = taken.bodies(episodes, seed=seed)
    rows = run_episode(bodies, taken.policy, design=taken.design.repeat(episodes, 1), deterministic=True)["next"]
    table = pd.DataFrame(
        {
            "source": readable(str(taken.source)),
            "policy": taken.of,
            "run": "" if taken.run is None else taken.run,
            "seed": seed,
            "episode": range(1, episodes + 1),
            "return": rows["reward"].sum(0).flatten().tolist(),
            "broken": rows["terminated"].sum(0).flatten().tolist(),
        }
    )
    for name, factor in zip(design_columns(bodies.design_names()), taken.design.tolist()):
        table[name] = float(shortest(factor))
    return table


def told(taken: Taken, table: pd.DataFrame) -> list[str]:
    """The result in words: mean, standard deviation and range, and the run's own best for comparison."""
    returns = table["return"]
    spread = f" ± {number(returns.std())} (standard deviation)" if len(table) > 1 else ""
    lines = [
        f"{taken.name}: return {number(returns.mean())}{spread}, {number(returns.min())} to {number(returns.max())}, "
        f"in {len(table)} episode{'s' if len(table) > 1 else ''} of {taken.settings['episode_steps']} steps"
    ]
    if taken.tried is not None:
        best = number(taken.tried.best_return)
        lines.append(f"its best evaluation in the run, the highest if there were several, had {best}")
    if broken := int(table["broken"].sum()):
        lines.append(f"the simulation broke {broken} times and began again; see the column broken")
    return lines


def write_table(table: pd.DataFrame, path: Path) -> None:
    """Write the rows.

    Raises:
        OSError: if it cannot be written; the message names ``--out`` where that is the way out.
    """
    with naming_out(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, as_csv(list(table.columns), rows_of(table)))
