"""Draw the figures of archived studies, and the page that shows them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl

from coim.experiments.drawing.layout import FONT, lay_out
from coim.experiments.figures import (
    best_returns,
    cartpole,
    comparisons,
    design_plane,
    error_curves,
    from_scratch,
    summary,
)
from coim.experiments.figures.made import made_by, made_otherwise
from coim.experiments.figures.plot import Plot
from coim.experiments.model_error.tables import FOLDER
from coim.experiments.run.atomic_write import as_csv, naming_out, write_whole, written_aside
from coim.experiments.run.progress import counted
from coim.experiments.run.records import number
from coim.experiments.statistics.intervals import FEW
from coim.experiments.study.arms import arm_named
from coim.experiments.study.runs import read_runs

MODULES = (summary, best_returns, from_scratch, error_curves, design_plane, cartpole, comparisons)
OF_MODELS = (error_curves, design_plane, cartpole)  # what a folder without cells has, Fig. 4
SUFFIXES = ("png", "pdf", "csv", "md")
TITLE = "# Figures of "
RESOLUTION = 150  # dots per inch of a PNG


def write_figures(study: Path, out: Path | None = None) -> list[Plot]:
    """Write every figure that has data.

    Args:
        study: its folder.
        out: folder for the figures; by default ``figures/`` in the study's.

    Returns:
        The plots, also those that have no figure because their input is not there.

    Raises:
        ValueError: if the folder holds neither a study nor a measured run, or the folder for the figures holds
            another page.
        OSError: if the figures cannot be written.
    """
    folder, found = out or study / "figures", []
    before = drawn_before(folder)
    measured_only = (study / FOLDER).is_dir() and not (study / "cells").is_dir()
    modules = OF_MODELS if measured_only else MODULES
    with mpl.rc_context(FONT), naming_out(folder):
        for module in counted(modules, len(modules), "figures"):
            for plot in module.plots(study):
                folder.mkdir(parents=True, exist_ok=True)
                write_plot(folder, plot)
                found.append(plot)
        for name in before - {plot.name for plot in found}:
            remove(folder, name)
        write_whole(folder / "README.md", page(study, found))
    return found


def drawn_before(folder: Path) -> set[str]:
    """Names of the plots on the page of an earlier drawing; they may differ from today's.

    Raises:
        ValueError: if the page that is there is no page of figures.
    """
    path = folder / "README.md"
    if not path.is_file():
        return set()
    there = path.read_text(encoding="utf-8")
    if not there.startswith(TITLE):
        raise ValueError(f"{path} is no page of figures and would be written over; name another folder with --out")
    return set(re.findall(r"^## (\w+)$", there, re.MULTILINE))


def remove(folder: Path, name: str) -> None:
    """Delete the files of one plot."""
    for suffix in SUFFIXES:
        (folder / f"{name}.{suffix}").unlink(missing_ok=True)


def write_plot(folder: Path, plot: Plot) -> None:
    """Write the files of one plot, or delete those of an earlier drawing if there is nothing to draw any more."""
    files = {suffix: folder / f"{plot.name}.{suffix}" for suffix in SUFFIXES}
    remove(folder, plot.name)
    if plot.figure is None:
        return
    lay_out(plot.figure)
    with written_aside(files["png"]) as aside:
        plot.figure.savefig(aside, dpi=RESOLUTION)
    with written_aside(files["pdf"]) as aside:
        plot.figure.savefig(aside, metadata={"CreationDate": None})
    rows = ({key: cell(value, digits=7) for key, value in row.items()} for row in plot.rows)
    write_whole(files["csv"], as_csv(list(plot.rows[0]), rows))
    if plot.table:
        write_whole(files["md"], "\n".join([plot.caption, "", table(plot.table), *notes(plot)]))


def page(study: Path, plots: Sequence[Plot]) -> str:
    """All figures with their captions, tables and notes, in Markdown."""
    lines = [
        f"{TITLE}{study.resolve().name}",
        "",
        f"Written by `coim figures`. {FEW}",
        "",
    ]
    if (study / "cells").is_dir():
        lines += [made_by(study), "", *made_otherwise(study), *arms_in_words(read_runs(study).arms)]
    for plot in plots:
        lines += [f"## {plot.name}", ""]
        if plot.figure is not None:
            files = ", ".join(f"[{suffix}]({plot.name}.{suffix})" for suffix in ("pdf", "csv"))
            lines += [f"![{plot.name}]({plot.name}.png)", "", f"{plot.caption} ({files})", ""]
        else:
            lines += [f"Not drawn. {plot.caption}", ""]
        lines += [table(plot.table)] if plot.table else []
        lines += notes(plot)
    return "\n".join(lines)


def notes(plot: Plot) -> list[str]:
    """Lines with the notes of a plot, a point of a list each."""
    selected = plot.table and {*plot.table[0]} < {*plot.rows[0]}
    more = [f"All columns are in the [CSV]({plot.name}.csv)."] if selected else []
    points = [f"- {note}" for note in (*plot.notes, *more)]
    return ["Notes:", "", *points, ""] if points else []


def arms_in_words(names: Sequence[str]) -> list[str]:
    """Lines with a table of arms: what each does, and what it is compared with."""
    rows = [{"arm": name, "what it does": (arm := arm_named(name)).words, "compared with": ", ".join(arm.baselines)}
            for name in names]  # fmt: skip
    return [table(rows)] if rows else []


def table(rows: Sequence[Mapping[str, object]]) -> str:
    """Rows as a Markdown table; numbers with three significant digits."""
    head = list(rows[0])
    lines = [head, ["---"] * len(head), *([str(cell(row[key], digits=3)) for key in head] for row in rows)]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def cell(value: object, *, digits: int) -> object:
    """A number with that many significant digits; an empty cell for an unknown one."""
    if isinstance(value, float):
        return ("" if digits > 3 else "-") if math.isnan(value) else number(value, digits)
    return value
