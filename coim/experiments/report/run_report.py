"""Write the page of one run, or of several runs side by side."""

from __future__ import annotations

import base64
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pandas as pd

from coim.envs import BODIES, MorphEnv
from coim.experiments.drawing.layout import FONT
from coim.experiments.frames import designs_of
from coim.experiments.report import designs, evidence, learning
from coim.experiments.report.imagined import imagination
from coim.experiments.report.page import Section, Table, narrow, page
from coim.experiments.run.atomic_write import dated_file, naming_out, write_whole
from coim.experiments.run.records import Record, number, read_records
from coim.run_folder import policy_path

MOST_OF_A_FILM = 10e6  # bytes; a larger one is not put into the page


def write_report(folders: Sequence[Path], *, out: Path | None = None, body: type[MorphEnv] | None = None) -> Path:
    """Write one self-contained page.

    Args:
        folders: run folders, at least one.
        out: the page, or a folder for it. The default is ``report.html`` in the run folder for one run, and
            ``runs/comparison-DATE.html`` for several.
        body: environment that the designs belong to. The default is the environment of the run's name; if coim has no
            such environment, the bodies are not drawn.

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
        sections = sections_of(records, body)
    if len(records) == 1:
        sections[0] = with_film(sections[0], folders[0], records[0], body)
    title = f"{records[0].environment}: {', '.join(record.name for record in records)}"
    path = place_of(out, folders)
    with naming_out(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, page(title, sections))
    return path


def place_of(out: Path | None, folders: Sequence[Path]) -> Path:
    """Path of the page; see ``out`` of `write_report`."""
    if len(folders) == 1:
        out = out or folders[0]
    elif out is None:
        return dated_file("comparison", ".html")
    return out / ("report.html" if len(folders) == 1 else "comparison.html") if out.is_dir() else out


def sections_of(records: Sequence[Record], body: type[MorphEnv] | None) -> list[Section]:
    """All sections in the order of the page. A new section is a function and a line here; None is left out."""
    sections = [
        best_bodies(records[0]) if len(records) == 1 else comparison(records),
        designs.best_returns(records),
        learning.learning_curves(records, body),
        designs.designs_over_time(records, body),
        designs.bodies(records, body),
        designs.predictions(records),
        evidence.expectations(records),
        evidence.worth(records),
        learning.model_errors(records),
        imagination(records),
        learning.losses(records),
        learning.times(records),
        in_full("Settings", records, [record.settings for record in records]),
        in_full("Versions and machine", records, [origin(record) for record in records]),
    ]
    return [section for section in sections if section is not None]


def best_bodies(record: Record) -> Section:
    """The best body of each run."""
    best = record.best
    head = ["run", "best return", "design", "kind", *record.design_names]
    rows = [
        [f"run {run}", number(row["best_return"]), str(row["design"]), row["kind"], *map(number, xi)]
        for (run, row), xi in zip(best.iterrows(), designs_of(best))
    ]
    if len(rows) > 1:
        rows.append([f"mean of {len(rows)} runs", number(best["best_return"].mean()), *[""] * (len(head) - 2)])
    return Section(title="Best bodies", notes=states([record]), tables=[*narrow(Table(head=head, rows=rows))])


def with_film(section: Section, folder: Path, record: Record, body: type[MorphEnv] | None) -> Section:
    """Add the film that ``coim watch`` made of the best body of all runs, or the commands that bring it here."""
    if record.best.empty:
        return section
    place = int(record.best["best_return"].argmax())
    run, design = int(record.best.index[place]), int(record.best["design"].iloc[place])
    words = f"design-{design}.mp4"
    films = [folder / "videos" / name for name in (words, f"run-{run}-{words}")]
    found = [film for film in films if film.is_file()]
    if found and found[0].stat().st_size < MOST_OF_A_FILM:
        return replace(section, film=base64.b64encode(found[0].read_bytes()).decode())
    ours = body is not None and BODIES.get(record.environment) is body  # coim watch asks for the class of another
    if found or not ours or not policy_path(folder, design).is_file():
        return section
    # Films are left to the reader: one takes seconds and OpenGL, and a study has hundreds of pages.
    watch, report = (shlex.join(["coim", command, str(folder)]) for command in ("watch", "report"))
    told = f"This page has no film of the best body yet. {watch} makes it, then {report} puts it here."
    return replace(section, notes=[*section.notes, told])


# Columns of the comparison: the name of each, and its text for a run folder. A new column is a line here.
COMPARED: dict[str, Callable[[Record], str]] = {
    "folder": lambda record: record.name,
    "runs": lambda record: str(record.num_runs),
    "best return, mean": lambda record: number(record.best["best_return"].mean()),
    "standard deviation": lambda record: number(record.best["best_return"].std()),
    "lowest": lambda record: number(record.best["best_return"].min()),
    "highest": lambda record: number(record.best["best_return"].max()),
    "designs": lambda record: str(record.designs["design"].nunique()),
    "episodes": lambda record: str(len(record.episodes[["design", "episode"]].drop_duplicates())),
    "diverged runs": lambda record: str(len(record.diverged)),
}


def comparison(records: Sequence[Record]) -> Section:
    """Statistics over the runs of each folder, of each run's best return."""
    rows = [[column(record) for column in COMPARED.values()] for record in records]
    return Section(title="Best returns", notes=states(records), tables=[*narrow(Table(head=[*COMPARED], rows=rows))])


def states(records: Sequence[Record]) -> list[str]:
    """Sentences on each folder: how far it is, which runs diverged, and how many simulations broke."""
    return [f"{record.name}: {sentence}" for record in records for sentence in (state(record), *ill(record))]


def state(record: Record) -> str:
    """A sentence on how far a run is."""
    last = record.episodes.iloc[-1]
    others = record.designs[~record.designs["run"].isin(record.diverged.index)]
    planned = record.settings.get("num_designs", "?")
    begun = f"started {record.config.get('started', 'at an unknown time')}, {record.num_runs} run(s)"
    if others.empty:
        return f"{begun}; every run has diverged, the last at {last['diverged']}, and it ended there."
    if last["design"] == planned and others["finished"].all():
        return f"{begun}; all {planned} designs are done, after {last['seconds'] / 60:.3g} min."
    where = f"design {last['design']} of {planned}, episode {last['episode']}"
    return f"{begun}; at {where} after {last['seconds'] / 60:.3g} min: going on, or stopped there."


def ill(record: Record) -> list[str]:
    """Sentences on runs that have diverged and on simulations that broke."""
    found = [
        f"run {run} diverged at {place}: its losses or weights were no longer finite numbers. It was "
        "frozen there and has no rows afterwards. Its best return is the best until then; curves over runs are means "
        "over the other runs from there on."
        for run, place in record.diverged["diverged"].items()
    ]
    broken = record.episodes.get("broken", pd.Series(dtype=float)).sum()
    return [*found, f"{broken:.0f} simulation(s) broke and started again from rest."] if broken > 0 else found


def origin(record: Record) -> dict[str, Any]:
    """The code and the machine of a run."""
    config = record.config
    return (
        {"revision": config.get("revision"), "started": config.get("started")}
        | dict(config.get("machine", {}))
        | {f"products in {dtype}": library for dtype, library in config.get("products", {}).items()}
        | dict(config.get("versions", {}))
    )


def in_full(title: str, records: Sequence[Record], values: Sequence[Mapping[str, Any]]) -> Section:
    """Named values of each folder; those that are not the same in all folders are marked."""
    names = list(dict.fromkeys(name for value in values for name in value))
    rows = [[name, *(plain(value.get(name)) for value in values)] for name in names]
    differing = frozenset(name for name, *cells in rows if len(set(cells)) > 1)
    table = Table(head=["", *(record.name for record in records)], rows=rows, marked=differing)
    return Section(title=title, tables=[*narrow(table)], folded=True)


def plain(value: Any) -> str:
    """A setting as it would be typed."""
    return "-" if value is None else " ".join(map(str, value)) if isinstance(value, list) else str(value)
