"""A run's folder with numbers that a hand can check, without a run."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

SETTINGS = {"num_designs": 6, "imagine": "none", "bodies": "search", "chosen_by": "value", "imagined_share": 0.2}
KINDS = ("first", "first", "first", "optimised", "random", "optimised", "random", "optimised")


def write_run(
    folder: Path,
    *runs: Sequence[float],
    told: Mapping[str, Sequence[float | None]] | None = None,
    measured: Mapping[str, Sequence[float]] | None = None,
    **settings: Any,
) -> Path:
    """Write one.

    Args:
        folder: is made.
        runs: the best return of each design of each run, each in one episode.
        told: more columns of ``designs.csv``, the same for every run.
        measured: columns of ``metrics.csv``, the same for every run.
        settings: that differ from `SETTINGS`.
    """
    folder.mkdir(parents=True)
    config = {"environment": "hopper", "settings": SETTINGS | {"num_runs": len(runs)} | settings}
    (folder / "config.json").write_text(json.dumps(config))
    episodes, designs, metrics = [], [], []
    told, measured = told or {}, measured or {}
    for run, returns in enumerate(runs):
        for i, best in enumerate(returns):
            row = {"run": run, "design": i + 1, "kind": KINDS[i], "xi_torso": 1 + i / 10}
            row |= dict.fromkeys(("xi_thigh", "xi_shank", "xi_foot"), 1.0)
            error = measured["model_error"][i] if "model_error" in measured else None
            told_here = {"episode": 1, "return": best, "env_steps": 10 * (i + 1), "model_error": error, "seconds": 1.0}
            episodes.append(row | told_here)
            designs.append(row | {"predicted": i, "best_return": best} | {name: told[name][i] for name in told})
            metrics.append({"run": run, "design": i + 1, "episode": 1} | {name: measured[name][i] for name in measured})
    for name, rows in (("evaluations", episodes), ("designs", designs), ("metrics", metrics)):
        with (folder / f"{name}.csv").open("w", newline="") as file:
            table = csv.DictWriter(file, rows[0], lineterminator="\n")
            table.writeheader()
            table.writerows(rows)
    return folder
