"""Folders as a study leaves them, with numbers that a hand can check, without a run."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from coim.experiments.figures.plot import Plot
from coim.experiments.study.ledger import Entry, State, in_csv
from coim.experiments.study.runs import parts_of
from coim.run_folder import EXPECTED

SETTINGS = {
    "num_designs": 4,
    "first_episodes": 2,
    "episodes": 2,
    "num_runs": 1,
    "episode_steps": 10,
    "gamma": 0.9,
    "imagine": "known",
    "individual_updates": 5,
    "population_updates": 3,
    "model_updates": 2,
}
COLUMNS = ["run", "design", "kind", "xi_1", "xi_2", "episode", "return", "env_steps", "seconds", "diverged"]
KINDS = ("first", "first", "optimised", "random")


def write_cell(
    study: Path,
    name: str,
    /,
    *runs: Sequence[float],
    kinds: Sequence[str] = KINDS,
    predicted: Sequence[float | None] = (None, 1.0, 2.0, 3.0, 4.0, 5.0),
    diverged: Sequence[int] = (),
    expected: Sequence[tuple[float, float] | None] = (),
    part: str = "cells",
    **settings: object,
) -> Path:
    """A cell's folder.

    Args:
        study: its folder.
        name: of the cell.
        runs: the best return of each design of each run; fewer than ``num_designs`` are a run under way.
        kinds: of each design.
        predicted: Q(xi) of each design.
        diverged: runs that diverged on the last design they have.
        expected: what a posterior expected of each design, and its deviation; by default there was none.
        part: of the study's folder.
        settings: that differ from `SETTINGS`.
    """
    folder = study / part / name
    folder.mkdir(parents=True)
    settings = SETTINGS | {"num_runs": len(runs)} | settings
    (folder / "config.json").write_text(json.dumps({"environment": name.split("-")[0], "settings": settings}))
    episodes, designs = [], []
    for run, returns in enumerate(runs):
        for index, best in enumerate(returns):
            place = [run, index + 1, kinds[index], 0.5 + index / 4, 1.0]
            last = "design 3, episode 2" if run in diverged and index + 1 == len(returns) else ""
            for episode, value in enumerate((best - 1, best)):  # the best comes second
                steps = (2 * index + episode + 1) * 10
                episodes.append([*place, episode + 1, value, steps, 36 * (2 * index + episode + 1), last])
            told = list(expected[index] or (None, None)) if expected else []
            designs.append([*place, predicted[index], best, *told, last])
    write_table(folder / "evaluations.csv", COLUMNS, episodes)
    write_table(
        folder / "designs.csv",
        [*COLUMNS[:5], "predicted", "best_return", *(EXPECTED if expected else ()), "diverged"],
        designs,
    )
    return folder


def write_ledger(study: Path, states: Mapping[str, State]) -> None:
    """The ledger of a study: the state of each cell by its name."""
    rows = []
    for name, state in states.items():
        environment, task, arm, seed = parts_of(name)
        rows.append(Entry(name, environment, task, arm, seed, state))
    (study / "ledger.csv").write_text(in_csv(rows))


def write_table(path: Path, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([columns, *rows])


def read_table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def check_words(plots: Iterable[Plot]) -> None:
    """Captions that a reader takes in at a glance, and tables that fit on a page."""
    for plot in plots:
        assert len(plot.caption.split()) <= 60, plot.caption
        assert all(len(row) <= 10 for row in plot.table), plot.name
