"""Fig. 4(b): how the next state changes with the body, predicted and true, over two components of the design space.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Sec. 6.5 and Fig. 4(b).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from coim.experiments.drawing.layout import new_figure
from coim.experiments.drawing.palette import CIRCLE, put_legend
from coim.experiments.figures.plot import Plot, missing
from coim.experiments.frames import read_frame, rows_of
from coim.experiments.model_error.tables import CHANGES, FOLDER, Kind, folders_with, name_of
from coim.pairs import IN_THE_FLOOR

SOURCES = {"delta": "model of changes", "next": "model of next states", "simulator": "simulator"}
STEM = "figure_4b_design_space"
SHOWN = (1e-3, 1e2)  # variances of one-step changes; beyond, colours end


def plots(study: Path) -> Iterator[Plot]:
    """A row of panels for each state: two models and the simulator, from the first folder of each kind of run."""
    found = folders_with(study, CHANGES.file)
    if not found:
        line = f"coim model-error ENVIRONMENT --out {study / FOLDER}"
        yield missing(STEM, f"No model was looked into at the end of its run: {line}")
    for kind, (folder, *others) in found.items():
        name, rows = name_of(STEM, kind, found), read_frame(folder / CHANGES.file, CHANGES)
        notes = (*notes_on(rows), told_of(folder, others, study))
        yield Plot(
            name=name,
            figure=drawn(rows),
            rows=rows_of(rows),
            caption=caption(kind),
            notes=notes,
            table=medians(rows),
        )


def drawn(rows: pd.DataFrame) -> Figure:
    """A line of panels for each state, a column for each source."""
    states = sorted({*rows["state"]})
    figure, grid = new_figure(1.0 + 1.7 * len(states), len(states), len(SOURCES))
    panels = iter(grid)
    for state in states:
        own = rows[rows["state"] == state]
        line = [next(panels) for _ in SOURCES]
        for axes, (source, title) in zip(line, SOURCES.items()):
            mesh = draw(axes, own, source)
            axes.set_title(title if state == states[0] else "", fontsize=10)
        line[0].set(ylabel=f"state {state}\ncomp. 2")
    for axes in line:
        axes.set(xlabel="component 1")
    bar = figure.colorbar(mesh, ax=grid, extend="both", shrink=0.8)
    bar.set_label("squared change of the next state\n(variances of one-step changes, 1)")
    put_legend(figure, handles())
    return figure


def draw(axes: Axes, rows: pd.DataFrame, source: str) -> QuadMesh:
    """One state and one source: colours over the plane, hatched where the state is impossible."""
    grid = rows[rows["point"] == "grid"]
    change, depth = (
        grid.pivot(index="pc_2", columns="pc_1", values=name) for name in (f"normalised/{source}", "depth")
    )
    x, y = change.columns.to_numpy(), change.index.to_numpy()
    norm = LogNorm(*SHOWN, clip=True)
    mesh = axes.pcolormesh(x, y, change, norm=norm, cmap="cividis", shading="nearest", rasterized=True)
    if (depth > IN_THE_FLOOR).any(axis=None):
        axes.contourf(x, y, depth, levels=[IN_THE_FLOOR, np.inf], colors="none", hatches=["////"])
        axes.contour(x, y, depth, levels=[IN_THE_FLOOR], colors="white", linewidths=0.8)
    tried = rows[rows["point"] == "tried"]
    around = [withStroke(linewidth=2, foreground="grey")]  # a cross may lie beyond the plane's bounds, on white
    axes.plot(
        tried["pc_1"], tried["pc_2"], "x", color="white", markersize=3.5, markeredgewidth=0.8, path_effects=around
    )
    axes.plot(0, 0, "o", clip_on=False, **CIRCLE)
    axes.set(aspect="equal", xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    return mesh


def handles() -> list[Line2D | Patch]:
    """The legend: what is marked."""
    return [
        Line2D([], [], marker="o", linestyle="", label="the state's own design", **CIRCLE),
        Line2D([], [], marker="x", linestyle="", color="grey", markersize=4, label="designs tried, projected"),
        Patch(facecolor="lightgrey", edgecolor="black", hatch="////", label="state impossible: body in the floor"),
    ]


def caption(kind: Kind) -> str:
    """What is drawn."""
    return (
        f"Squared change of the next state when only the design changes, for stored states and actions: "
        f"{kind.environment}, {kind.task}, {kind.designs} designs. Axes: the first two principal components of the "
        "designs tried, through the state's own design. White: out of bounds. Hatched: the body would be in the floor."
    )


def notes_on(rows: pd.DataFrame) -> list[str]:
    """How states and planes were chosen."""
    shares = " and ".join(f"{rows[key].iloc[0]:.0%}" for key in ("share_1", "share_2"))
    return [
        "States and actions are drawn at random among those whose plane has an area within the bounds.",
        f"The two components are in scale factors and hold {shares} of the variance of the designs tried.",
        f"A state is impossible where more than {IN_THE_FLOOR * 100:.0f} cm of the body would be in the floor.",
        "The table has the medians over the points of all planes, in variances of one-step changes.",
    ]


def medians(rows: pd.DataFrame) -> list[dict[str, object]]:
    """Median change by each source, where the state is possible and where it is not."""
    grid = rows[rows["point"] == "grid"]
    deep = grid["depth"] > IN_THE_FLOOR
    return [
        {"state": words} | {title: float(chosen[f"normalised/{source}"].median()) for source, title in SOURCES.items()}
        for words, chosen in (("possible", grid[~deep]), ("impossible", grid[deep]))
        if len(chosen)
    ]


def told_of(folder: Path, others: Sequence[Path], study: Path) -> str:
    """Which run's models these are, and which runs are not drawn."""
    first, *rest = (path.relative_to(study).as_posix() for path in (folder, *others))
    return f"The models are those of {first}" + (f", the first by name. Not drawn: {', '.join(rest)}." if rest else ".")
