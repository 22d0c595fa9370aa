"""Write the page of one run, or of several runs side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pandas as pd

from coim.envs import BODIES, MorphEnv
from coim.experiments.frames import designs_of
from coim.experiments.report import designs as figures
from coim.experiments.report import learning as diagnostics
from coim.experiments.report.designs import Picture
from coim.experiments.report.page import FONT, image, note, page, section, table
from coim.experiments.run.atomic_write import dated_file, naming_out, write_whole
from coim.experiments.run.records import Record, number, read_records


def write_report(folders: Sequence[Path], *, out: Path | None = None, body: type[MorphEnv] | None = None) -> Path:
    """Write one self-contained page.

    Args:
        folders: of the runs, at least one.
        out: the page, or a folder for it; by default ``report.html`` in the run's folder. That is the page of one run:
            a comparison is called otherwise, ``runs/comparison-DATE.html`` by default.
        body: what the designs belong to; by default what the environment's name says, and if no such environment is
            known the bodies are not drawn.

    Returns:
        The page.

    Raises:
        ValueError: if there is no folder, one is no run or has no rows yet, or their environments differ.
        OSError: if the page cannot be written.
    """
    if not folders:
        raise ValueError("no folder is named; give at least one, such as runs/hopper-20260101-120000-run")
    records = read_records(folders)
    body = body or BODIES.get(records[0].environment)
    with mpl.rc_context(FONT):
        sections = [in_short(records), *(show(picture) for picture in pictures_of(records, body)), *in_full(records)]
    title = f"{records[0].environment}: {', '.join(record.name for record in records)}"
    path = place_of(out, folders)
    with naming_out(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, page(title, sections))
    return path


def place_of(out: Path | None, folders: Sequence[Path]) -> Path:
    """Where a page goes, as `write_report` says."""
    if len(folders) == 1:
        out = out or folders[0]
    elif out is None:
        return dated_file("comparison", ".html")
    return out / ("report.html" if len(folders) == 1 else "comparison.html") if out.is_dir() else out


def pictures_of(records: Sequence[Record], body: type[MorphEnv] | None) -> list[Picture]:
    """All pictures, in the order in which they are read."""
    return [
        figures.best_returns(records),
        diagnostics.learning_curves(records),
        figures.designs_over_time(records, body),
        figures.bodies(records, body),
        figures.predictions(records),
        diagnostics.model_errors(records),
        diagnostics.losses(records),
        diagnostics.times(records),
    ]


def show(picture: Picture) -> str:
    """The section of a picture, or of the sentence that says why there is none."""
    if picture.figure is None:
        return section(picture.title, note(picture.caption))
    return section(picture.title, image(picture.figure, alt=picture.alt, caption=picture.caption), kind="picture")


def in_short(records: Sequence[Record]) -> str:
    """Where each folder stands, and its best returns: a table by folder, or of one folder by run."""
    states = "".join(
        note(f"{record.name}: {sentence}") for record in records for sentence in (state(record), *ill(record))
    )
    if len(records) == 1:
        head = ["run", "best return", "design", "kind", *records[0].design_names]
        best, diverged = records[0].best, records[0].diverged
        rows = [
            [f"run {run}", number(row["best_return"]), str(row["design"]), row["kind"], *map(number, xi)]
            for (run, row), xi in zip(best.iterrows(), designs_of(best))
        ]
        if len(diverged):
            head.append("diverged at")
            places = diverged["diverged"].reindex(best.index, fill_value="-")
            rows = [[*row, place] for row, place in zip(rows, places)]
        if len(rows) > 1:
            mean = best["best_return"].mean()
            rows.append([f"mean of {len(rows)} runs", number(mean), *[""] * (len(head) - 2)])
        return section("Best bodies", states + table(head, rows))
    head = ["folder", "runs", "best return, mean", "standard deviation", "lowest", "highest", "designs", "episodes"]
    head.append("diverged runs")
    return section("Best returns", states + table(head, [compared(record) for record in records]))


def compared(record: Record) -> list[str]:
    """A row of the comparison: statistics over the runs of a folder, of each run's best return."""
    returns = record.best["best_return"]
    statistics = (returns.mean(), returns.std(), returns.min(), returns.max())
    counts = map(
        str,
        (
            record.designs["design"].nunique(),
            len(record.episodes[["design", "episode"]].drop_duplicates()),
            len(record.diverged),
        ),
    )
    return [record.name, str(record.num_runs), *map(number, statistics), *counts]


def state(record: Record) -> str:
    """How far a run is, in a sentence."""
    last = record.episodes.iloc[-1]
    learning = record.designs[~record.designs["run"].isin(record.diverged.index)]
    planned = record.settings.get("num_designs", "?")
    begun = f"started {record.config.get('started', 'at an unknown time')}, {record.num_runs} run(s)"
    if learning.empty:
        return f"{begun}; every run has diverged, the last at {last['diverged']}, and it ended there."
    if last["design"] == planned and learning["finished"].all():
        return f"{begun}; all {planned} designs are done, after {last['seconds'] / 60:.3g} min."
    where = f"design {last['design']} of {planned}, episode {last['episode']}"
    return f"{begun}; at {where} after {last['seconds'] / 60:.3g} min: going on, or stopped there."


def ill(record: Record) -> list[str]:
    """What a reader must know of runs that have diverged, and of simulations that broke."""
    found = [
        f"run {run} diverged at {place}: its losses or weights were no finite numbers any more. It was "
        "frozen there and has no rows afterwards. Its best return is the best until then; curves over runs are means "
        "of those that were left."
        for run, place in record.diverged["diverged"].items()
    ]
    broken = record.episodes.get("broken", pd.Series(dtype=float)).sum()
    return [*found, f"{broken:.0f} simulation(s) broke and started again from rest."] if broken > 0 else found


def in_full(records: Sequence[Record]) -> list[str]:
    """The settings, the versions and the machine of each folder."""
    several = len(records) > 1
    origin = [
        {"revision": r.config.get("revision"), "started": r.config.get("started")}
        | dict(r.config.get("machine", {}))
        | {f"products in {dtype}": library for dtype, library in r.config.get("products", {}).items()}
        | dict(r.config.get("versions", {}))
        for r in records
    ]
    found = []
    for title, values in (("Settings", [r.settings for r in records]), ("Versions and machine", origin)):
        names = list(dict.fromkeys(name for value in values for name in value))
        rows = [[name, *(plain(value.get(name)) for value in values)] for name in names]
        found.append(section(title, table(["", *(r.name for r in records)], rows, differing=several)))
    return found


def plain(value: Any) -> str:
    """A setting as it would be typed."""
    return "-" if value is None else " ".join(map(str, value)) if isinstance(value, list) else str(value)
