"""Write the atlas of one run, or of several.

Shapes: N bodies, D design.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from torch import Tensor

from coim.envs import BODIES, MorphEnv
from coim.experiments.atlas import alike, gains, walkers
from coim.experiments.atlas.simulator import FETCH, Simulator, read_simulator
from coim.experiments.frames import designs_of, rows_of
from coim.experiments.predictions import prediction_interval
from coim.experiments.run.atomic_write import dated_file, naming_out, write_whole
from coim.experiments.run.records import Record, number, read_records
from coim.run_folder import policy_path
from coim.saved_run import SavedRun, load_run

HERE = Path(__file__).parent
MOST_WALKS = 40  # recorded in a page; of more bodies the best ones of each run
SCRIPTS = ("walk.js", "charts.js", "atlas.js")


@dataclass
class RunPart:
    """One run of a folder, as the page shows it.

    Attributes:
        name: its name on the page.
        bodies: its rows, with the outline of each.
        best: place of the best body in ``bodies``.
        policies: policies by name, as `walkers.policy_table` gives them.
        walks: recorded walks by the number of the design.
        gains: for each way to estimate them, an estimate for each length.
        notes: sentences.
    """

    name: str
    bodies: list[dict[str, Any]]
    best: int
    policies: dict[str, Any] = field(default_factory=dict)
    walks: dict[int, Any] = field(default_factory=dict)
    gains: dict[str, list[dict[str, float]]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def write_atlas(
    folders: Sequence[Path],
    *,
    out: Path | None = None,
    body: type[MorphEnv] | None = None,
    mujoco: Path | None = None,
) -> tuple[Path, str]:
    """Write one page that opens from a file, without a network.

    Args:
        folders: run folders of one environment, at least one.
        out: the page, or a folder for it. The default is ``atlas.html`` in the run folder for one, and
            ``runs/atlas-DATE.html`` for several.
        body: environment that the designs belong to. The default is the environment of the run's name.
        mujoco: the package of `coim.experiments.atlas.simulator`; robots then walk in the page on any body. Without it,
            recorded walks are played.

    Returns:
        The page, and why it does not simulate the robot; an empty word if it does.

    Raises:
        ValueError: if there is no folder, one is no run or has no best return yet, their environments differ or are
            unknown, or ``mujoco`` is no such package.
        OSError: if the page cannot be written.
    """
    if not folders:
        raise ValueError("no folder is named; give at least one, such as runs/hopper-20260101-120000-run")
    simulator = None if mujoco is None else read_simulator(mujoco)
    records = read_records(folders)
    environment = records[0].environment
    body = body or BODIES.get(environment)
    if body is None:
        raise ValueError(f"{environment!r} is none of {', '.join(BODIES)}; name its class with --body module:Class")
    torch.set_num_threads(1)
    runs = [part for record, folder in zip(records, folders) for part in _parts(record, folder, body, len(folders))]
    if not runs:
        raise ValueError(f"{folders[0]} has no best return yet; wait for the first row of its designs.csv")
    why = walkers.body_table(body(num_runs=1, seed=0))["why"]
    if not why and simulator is None:
        why = f"a browser needs MuJoCo for it: {FETCH}, and --mujoco"
    if not why and not any(run.policies for run in runs):
        why = "no run has a policy that can be read"
    path = _place(out, folders)
    with naming_out(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, page(f"Atlas of {environment}", body, runs, simulator))
    return path, why


def page(title: str, body: type[MorphEnv], runs: Sequence[RunPart], simulator: Simulator | None) -> str:
    """The whole page."""
    bodies = body(num_runs=1, seed=0)
    low, high = (bound.numpy() for bound in bodies.design_bounds())
    best = [run.bodies[run.best] for run in runs]
    table = alike.distances(np.array([row["design"] for row in best]), low, high)
    data = {
        "body": walkers.body_table(bodies),
        "frame_seconds": walkers.frame_seconds(bodies),
        "runs": [asdict(run) for run in runs],
        "distances": table.round(3).tolist(),
    }
    if data["body"]["texts"] is None:
        simulator = None
    environment = Environment(
        loader=FileSystemLoader(HERE), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["number"] = number
    return environment.get_template("atlas.html").render(
        title=title,
        names=bodies.design_names(),
        runs=runs,
        distances=table,
        alike=alike.in_words(table, len(low), [row["kind"] for row in best]) if len(runs) > 1 else "",
        why=data["body"]["why"],
        data=data,
        simulator=simulator,
        scripts=[(HERE / name).read_text() for name in SCRIPTS],
    )


def _place(out: Path | None, folders: Sequence[Path]) -> Path:
    """Path of the page; see ``out`` of `write_atlas`."""
    if out is None:
        return folders[0] / "atlas.html" if len(folders) == 1 else dated_file("atlas", ".html")
    return out / "atlas.html" if out.is_dir() else out


def _parts(record: Record, folder: Path, body: type[MorphEnv], num_folders: int) -> list[RunPart]:
    """Every run of a folder that has a best return."""
    parts = []
    for run, rows in record.designs.groupby("run", sort=True):
        known = rows[np.isfinite(rows["best_return"])].sort_values("design")
        if known.empty:
            continue
        names = [record.name] * (num_folders > 1) + [f"run {run}"] * (record.designs["run"].nunique() > 1)
        part = RunPart(", ".join(names) or record.name, _rows(known, body), int(np.argmax(known["best_return"])))
        share = max(1, MOST_WALKS // (num_folders * record.designs["run"].nunique()))
        _add_networks(part, record, folder, int(str(run)), body, share)
        parts.append(part)
    return parts


def _rows(designs: pd.DataFrame, body: type[MorphEnv]) -> list[dict[str, Any]]:
    """Bodies in the order of building: number, kind, design, outline, best return, and what was expected of it."""
    entries, low_high = designs_of(designs), prediction_interval(designs["expected"], designs["deviation"])
    shapes = walkers.outlines(body, entries)
    return [
        {
            "number": int(row["design"]),
            "kind": row["kind"],
            "design": entry.tolist(),
            "outline": outline,
            "best": row["best_return"],
            # JSON has no NaN
            **{
                name: float(value) if math.isfinite(value) else None
                for name, value in (("expected", row["expected"]), ("low", low), ("high", high))
            },
        }
        for row, entry, outline, low, high in zip(rows_of(designs), entries, shapes, *low_high)
    ]


def _add_networks(part: RunPart, record: Record, folder: Path, run: int, body: type[MorphEnv], most_walks: int) -> None:
    """Add policies, walks and gains, as far as the folder has what they need."""
    try:
        saved = load_run(folder, run=run, body=body)
    except ValueError as error:
        part.notes.append(f"No policy and no gradient: {error}.")
        return
    best = part.bodies[part.best]
    part.policies["of all bodies"] = walkers.policy_table(saved.population.policy)
    if policy_path(folder, best["number"]).is_file():
        part.policies[f"of body {best['number']}"] = walkers.policy_table(saved.policy_of(best["number"]))
    ranked = sorted(part.bodies, key=lambda row: -row["best"])[:most_walks]
    walks = {row["number"]: _walk(saved, folder, row) for row in ranked}
    part.walks = {number: walk.table() for number, walk in walks.items()}
    _add_gains(part, saved, list(walks.values()), torch.tensor(best["design"], dtype=torch.float64))


def _walk(saved: SavedRun, folder: Path, row: dict[str, Any]) -> walkers.Walk:
    """A body's walk by the policy of its best evaluation, or the population's if that was not kept."""
    kept = policy_path(folder, row["number"]).is_file()
    policy = saved.policy_of(row["number"]) if kept else saved.population.policy
    return walkers.record_walk(saved.bodies, policy, torch.tensor(row["design"]))


def _add_gains(part: RunPart, saved: SavedRun, walks: Sequence[walkers.Walk], best: Tensor) -> None:
    bodies, agent = saved.bodies, saved.population
    designs = torch.tensor([row["design"] for row in part.bodies])
    returns = torch.tensor([row["best"] for row in part.bodies], dtype=torch.float64)
    found: dict[str, list[gains.Gain]] = {}
    try:
        found["returns"] = gains.gains_by_returns(bodies, agent, walks, designs, returns, best)
    except ValueError as error:
        part.notes.append(f"No estimate from the returns: {error}.")
    found["critics"] = gains.gains_by_critics(bodies, agent, walks, best, gamma=saved.settings["gamma"])
    told = {"returns": "By the returns of the bodies built", "critics": "By the critics"}
    for name, estimates in found.items():
        part.gains[name] = [asdict(gain) for gain in estimates]
        part.notes.append(f"{told[name]}, {gains.in_words(estimates, bodies.design_names(), bodies, best)}.")
