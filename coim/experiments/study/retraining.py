"""Choose the best designs of a study's runs, to be trained again from scratch."""

from __future__ import annotations

import itertools
import math
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import tyro

from coim.experiments.run.atomic_write import as_csv, shortest, write_whole
from coim.experiments.run.last_words import plain_sac
from coim.experiments.run.records import Row
from coim.experiments.run.resume import saved_settings
from coim.experiments.study.definition import Cell
from coim.experiments.study.runs import CHOSEN, Place, Run, Runs
from coim.tables import read_cells

RULE = {"top": 0.5, "most": 18}  # of Fig. 2
Line = dict[str, str]


@dataclass(frozen=True, kw_only=True)
class Retrain:
    """Retrain the best designs of a study from scratch, with plain SAC."""

    study: tyro.conf.Positional[Path]
    """Folder of the study."""
    arms: tuple[str, ...] = ()
    """Whose designs; by default those of all arms of the study that search for them (Fig. 2 has none and known)."""
    top: float | None = None
    """Share of each run's optimised designs, the best ones; by default what was chosen by before, or 0.5 (Fig. 2)."""
    most: int | None = None
    """At most so many of each arm, environment and task, but one of each run; by default as before, or 18 (Fig. 2)."""
    episodes: int | None = None
    """Training episodes on each; by default as many as the study gave to a first design."""
    workers: int = 0
    """Designs at once on this machine, each on one core; 0 takes as many as there are cores."""
    ray_address: str | None = None
    """A Ray cluster, such as auto or 10.0.0.1:6379; by default this machine."""
    gpus: float = 0.0
    """Share of a GPU for each; above 0 its networks live there, wherever those of the study did."""


@dataclass(frozen=True)
class Retraining(Cell):
    """A design that is trained from scratch.

    Attributes:
        folder: named after the cell, the run and the design that it comes from.
    """

    folder: str

    @property
    def name(self) -> str:
        """Of its folder."""
        return self.folder


def choose(runs: Runs, path: Path, asked: Retrain) -> list[Line]:
    """Lines of ``designs.csv``: those that stand there, and those of arms that are asked for and have none there."""
    lines: list[Line] = read_cells(path, CHOSEN)
    for arm in asked.arms:
        if arm not in runs.arms:
            raise ValueError(f"{arm!r} is no arm of {asked.study}; name some of its own: --arms {' '.join(runs.arms)}")
    rule, arms = rule_of(lines, asked), asked.arms or runs.arms
    for place in runs.places:
        there = {line["arm"] for line in lines if (line["environment"], line["task"]) == place}
        lines += best_designs(runs, place, [arm for arm in arms if arm not in there], rule)
    if not lines:
        raise ValueError(f"no run of {', '.join(arms)} has an optimised design yet; let the study go on")
    there = {(line["environment"], line["task"], line["arm"]) for line in lines}
    for place, arm in itertools.product(runs.places, arms):
        if arm in runs.arms_at(place) and (*place, arm) not in there:
            print(f"{', '.join(place)}: no run of {arm} has an optimised design, there is nothing to retrain of it")
    write_whole(path, as_csv(list(dict.fromkeys(key for line in lines for key in line)), lines))
    return lines


def rule_of(lines: Sequence[Line], asked: Retrain) -> dict[str, float]:
    """``top`` and ``most``: what is asked for, or was chosen by before.

    Raises:
        ValueError: if the two differ. What was chosen stays, and arms that come beside it are compared with it.
    """
    rule: dict[str, float] = {}
    for name, usual in RULE.items():
        wanted = getattr(asked, name)
        used = next((type(usual)(line[name]) for line in lines if line.get(name)), None)
        if None not in (wanted, used) and wanted != used:
            raise ValueError(
                f"--{name} is {wanted}, but the designs in {asked.study}/retrained were chosen by {used}; leave the "
                "option out, or delete that folder to choose and train all of them anew"
            )
        rule[name] = next(value for value in (wanted, used, usual) if value is not None)
    return rule


def best_designs(runs: Runs, place: Place, arms: Sequence[str], rule: Mapping[str, float]) -> Iterator[Line]:
    """The best share of what each run of each arm found in one environment and task, best first.

    Args:
        runs: of the study.
        place: environment and task.
        arms: whose designs.
        rule: ``top``, the share, and ``most``, which is divided among the runs of the arm that has most of them, so
            that all arms select alike; where it does not come out even, the first seeds give one more.
    """
    each, more = divmod(int(rule["most"]), max(runs.planned[*place, arm] for arm in runs.arms_at(place)))
    share = Fraction(str(rule["top"]))  # 7 / 25 * 25 > 7 in floating point
    for arm in arms:
        found = [candidates(run) for run in runs.of(place, arm)]
        kept = [
            pair
            for i, own in enumerate(found)
            for pair in own[: min(max(1, each + (i < more)), math.ceil(share * len(own)))]
        ]
        noted = {"over": sum(run.over for run in runs.of(place, arm)), "planned": runs.planned[*place, arm]}
        noted |= {"found": sum(map(len, found)), "kept": len(kept), **rule}
        for run, row in sorted(kept, key=lambda pair: -pair[1]["best_return"]):
            yield line_of(run, row) | {name: str(value) for name, value in noted.items()}


def candidates(run: Run) -> list[tuple[Run, Row]]:
    """Designs that Eq. 5 chose, best first."""
    found = [(run, row) for row in run.designs if row["kind"] == "optimised"]
    return sorted(found, key=lambda pair: -pair[1]["best_return"])


def line_of(run: Run, row: Row) -> Line:
    """A design and where it comes from."""
    cell = run.record.name
    return {
        "folder": f"{cell}-run{run.number}-design{row['design']}",
        "cell": cell,
        "environment": run.environment,
        "task": run.task,
        "arm": run.arm,
        "seed": str(run.seed),
        "run": str(run.number),
        "design": str(row["design"]),
        "xi": " ".join(shortest(value) for value in row["xi"]),
        "found_return": shortest(row["best_return"]),
    }


def cell_of(line: Line, asked: Retrain) -> Retraining:
    """Plain SAC on one body: the settings of the cell that found it, less population, imagination and search."""
    settings = saved_settings(asked.study / "cells" / line["cell"])
    settings = plain_sac(
        settings,
        [float(xi) for xi in line["xi"].split()],
        first_episodes=settings.first_episodes if asked.episodes is None else asked.episodes,
        seed=zlib.crc32(line["folder"].encode()),  # of its own, so that no two samples share initial weights
        device="cpu",
        quiet=True,
    )
    return Retraining(line["environment"], line["arm"], settings, 0, line["folder"])
