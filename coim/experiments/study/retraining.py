"""Choose the best designs of a study's runs, to be trained again from scratch."""

from __future__ import annotations

import dataclasses
import itertools
import math
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import pandas as pd
import tyro

from coim.experiments.frames import at, designs_of, read_frame, rows_of
from coim.experiments.run.atomic_write import as_csv, shortest, write_whole
from coim.experiments.run.effect import without_effect
from coim.experiments.run.last_words import plain_sac
from coim.experiments.run.resume import ELSEWHERE, FREE, changes, saved_settings
from coim.experiments.study.definition import Cell
from coim.experiments.study.runs import CHOSEN, Place, Run, Runs, trained_in

RULE: dict[str, Any] = {"top": 0.5, "most": 18, "of": "optimised"}  # of Fig. 2
WORDS = {"optimised": "an optimised design", "all": "a design"}


@dataclass(frozen=True, kw_only=True)
class Retrain:
    """Retrain the best designs of a study from scratch, with plain SAC."""

    study: tyro.conf.Positional[Path]
    """Folder of the study."""
    arms: tuple[str, ...] = ()
    """Arms of the study whose designs are retrained; by default all that search for designs (Fig. 2: none, known)."""
    top: float | None = None
    """Share of each run's designs, the best ones; by default what was chosen by before, or 0.5 (Fig. 2)."""
    most: int | None = None
    """At most so many of each arm, environment and task, but one of each run; by default as before, or 18 (Fig. 2)."""
    of: Literal["optimised", "all"] | None = None
    """Designs to choose from: those that the search found, or all that the run built, so that arms without a search
    have some too. With --most 1 the best body of each run. By default as before, or optimised (Fig. 2)."""
    episodes: int | None = None
    """Training episodes on each; by default as many as the study gave to a first design."""
    together: int = 1
    """Designs of an arm that are trained in lock-step in one process, which a GPU does in about the time of one.
    What was chosen before stays as it is."""
    workers: int = 0
    """Designs at once on this machine, each on one core; 0 takes as many as there are cores."""
    ray_address: str | None = None
    """A Ray cluster, such as auto or 10.0.0.1:6379; by default this machine."""
    gpus: float = 0.0
    """Share of a GPU for each; above 0 its networks live there, wherever those of the study did."""


@dataclass(frozen=True)
class Retraining(Cell):
    """A design that is trained from scratch, or several together.

    Attributes:
        folder: named after the cell, the run and the design that it comes from, or after the arm.
    """

    folder: str

    @property
    def name(self) -> str:
        """Name of its folder."""
        return self.folder


def choose(runs: Runs, path: Path, asked: Retrain) -> pd.DataFrame:
    """Choose designs of arms that are asked for and have none in the file yet, and add them to it.

    Args:
        runs: of the study.
        path: of ``retrained/designs.csv``.
        asked: for which arms, and by which rule.

    Returns:
        All rows of the file, with the columns of `CHOSEN`.

    Raises:
        ValueError: if an arm is none of the study's, none has a design to choose from, what stands in the file was
            chosen by another rule, or designs that are to be trained together were found with different settings.
    """
    listed = read_frame(path, CHOSEN)
    for arm in asked.arms:
        if arm not in runs.arms:
            raise ValueError(f"{arm!r} is no arm of {asked.study}; name some of its own: --arms {' '.join(runs.arms)}")
    rule, arms = rule_of(listed, asked), asked.arms or runs.arms
    tables = [listed]
    for place in runs.places:
        there = {*at(listed, place)["arm"]}
        found = [best_designs(runs, place, arm, rule) for arm in arms if arm not in there]
        tables += [in_fleets(lines, asked.together) for lines in found if len(lines)]
    tables = [table for table in tables if len(table)]
    if not tables:
        raise ValueError(
            f"no run of {', '.join(arms)} has {WORDS[rule['of']]} yet; let the study go on"
            + (", or choose among all designs with --of all" if rule["of"] == "optimised" else "")
        )
    chosen = pd.concat(tables, ignore_index=True)
    for place, arm in itertools.product(runs.places, arms):
        if arm in runs.arms_at(place) and at(chosen, place, arm).empty:
            print(f"{', '.join(place)}: no run of {arm} has {WORDS[rule['of']]}, there is nothing to retrain of it")
    # Refuses before anything is written.
    cells_of((line for line in rows_of(chosen) if trained_in(line)[0] != line["folder"]), asked)
    noted = chosen.replace("", math.nan).dropna(axis="columns", how="all")  # older studies have noted less
    cells = noted.map(lambda value: shortest(value) if isinstance(value, float) else value, na_action="ignore")
    write_whole(path, as_csv(list(cells.columns), rows_of(cells.fillna(""))))
    return chosen


def rule_of(listed: pd.DataFrame, asked: Retrain) -> dict[str, Any]:
    """``top``, ``most`` and ``of``: what is asked for, or was chosen by before.

    Raises:
        ValueError: if the two differ. What was chosen stays, and arms that come beside it are compared with it.
    """
    rule: dict[str, Any] = {}
    for name, usual in RULE.items():
        wanted = getattr(asked, name)
        used = next((type(usual)(value or usual) for value in listed[name].dropna()), None)
        if None not in (wanted, used) and wanted != used:
            raise ValueError(
                f"--{name} is {wanted}, but the designs in {asked.study}/retrained were chosen by {used}; leave the "
                "option out, or delete that folder to choose and train all of them anew"
            )
        rule[name] = next(value for value in (wanted, used, usual) if value is not None)
    return rule


def best_designs(runs: Runs, place: Place, arm: str, rule: Mapping[str, Any]) -> pd.DataFrame:
    """The best share of what each run of an arm found or built in one environment and task, best first.

    Args:
        runs: of the study.
        place: environment and task.
        arm: whose designs.
        rule: ``top``, the share, and ``most``, which is divided among the runs of the arm that has most of them, so
            that all arms select alike; where it does not come out even, the first seeds give one more. ``of`` says
            which designs there are to choose from.

    Returns:
        A row for each design, with the columns of `CHOSEN`.
    """
    each, more = divmod(int(rule["most"]), max(runs.planned[*place, arm] for arm in runs.arms_at(place)))
    share = Fraction(str(rule["top"]))  # 7 / 25 * 25 > 7 in floating point
    own = runs.of(place, arm)
    found = [rows for run in own if len(rows := candidates(run, rule["of"]))]
    if not found:
        return pd.DataFrame(columns=CHOSEN.header())
    kept = pd.concat(
        rows.head(min(max(1, each + (i < more)), math.ceil(share * len(rows)))) for i, rows in enumerate(found)
    )
    noted = {"over": sum(run.over for run in own), "planned": runs.planned[*place, arm]}
    noted |= {"found": sum(map(len, found)), "kept": len(kept)}
    ranked = kept.sort_values("found_return", ascending=False, kind="stable", ignore_index=True)
    noted |= {name: rule[name] for name in ("top", "most")}
    return ranked.assign(**{name: float(value) for name, value in noted.items()}, of=rule["of"], trained="")


def candidates(run: Run, of: str) -> pd.DataFrame:
    """Designs, best first, and where they come from: the columns of `CHOSEN` that are needed."""
    rows = run.designs[run.designs["kind"] == "optimised"] if of == "optimised" else run.designs
    rows = rows.dropna(subset="best_return").sort_values("best_return", ascending=False, kind="stable")
    cell = run.record.name
    return pd.DataFrame(
        {
            "folder": [f"{cell}-run{run.number}-design{number}" for number in rows["design"]],
            "cell": cell,
            "environment": run.environment,
            "task": run.task,
            "arm": run.arm,
            "seed": run.seed,
            "run": run.number,
            "design": rows["design"].to_numpy(),
            "xi": [" ".join(map(shortest, design)) for design in designs_of(rows)],
            "found_return": rows["best_return"].to_numpy(),
        }
    )


def in_fleets(lines: pd.DataFrame, size: int) -> pd.DataFrame:
    """Designs of one arm in one place, each with the run that trains it if that is one of several in lock-step."""
    if size == 1:
        return lines
    places = [divmod(number, size) for number in range(len(lines))]
    names = lines["environment"] + "-" + lines["task"] + "-" + lines["arm"]
    return lines.assign(trained=[f"{name}-fleet{fleet}/{run}" for name, (fleet, run) in zip(names, places)])


def cells_of(lines: Iterable[Mapping[str, Any]], asked: Retrain) -> list[Retraining]:
    """What trains these designs: a run for each, or for each fleet."""
    by_folder: dict[str, list[Mapping[str, Any]]] = {}
    for line in lines:
        by_folder.setdefault(trained_in(line)[0], []).append(line)
    return [cell_of(folder, own, asked) for folder, own in by_folder.items()]


def cell_of(folder: str, lines: Sequence[Mapping[str, Any]], asked: Retrain) -> Retraining:
    """Plain SAC on these bodies: the settings of the cells that found them, less population, imagination and search.

    Raises:
        ValueError: if bodies that are to be trained together were found with different settings.
    """
    each = [
        plain_sac(
            saved_settings(asked.study / "cells" / line["cell"]),
            [float(xi) for line in lines for xi in line["xi"].split()],
            num_runs=len(lines),
            seed=zlib.crc32(folder.encode()),  # of its own, so that no two samples share initial weights
            device="cpu",
            quiet=True,
        )
        for line in lines
    ]
    if asked.episodes is not None:
        each = [dataclasses.replace(settings, first_episodes=asked.episodes) for settings in each]
    for line, settings in zip(lines, each):
        # Where a cell was computed, and what plain SAC does not read, makes no difference to its designs.
        of_no_effect = {*FREE, *ELSEWHERE, *without_effect(dataclasses.replace(settings, bodies="fixed"))}
        if unlike := sorted(changes(each[0], settings).keys() - of_no_effect):
            raise ValueError(
                f"the designs of {folder} cannot be trained together: cells {lines[0]['cell']} and {line['cell']} "
                f"differ in {', '.join(unlike)}; leave --together out to train each by itself"
            )
    return Retraining(lines[0]["environment"], lines[0]["arm"], each[0], 0, folder)
