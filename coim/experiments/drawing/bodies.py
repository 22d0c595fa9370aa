"""Bodies drawn as they stand at rest, side by side and to one scale."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tensordict import TensorDict

from coim.envs import MorphEnv
from coim.experiments.drawing.palette import KINDS, kind_handles, put_legend
from coim.experiments.frames import designs_of, rows_of
from coim.experiments.run.records import number

GAP = 0.3  # m between two bodies
BODIES_IN_A_LINE = 8


def draw_bodies(axes: Axes, rows: pd.DataFrame, body: type[MorphEnv]) -> None:
    """Draw designs from left to right on one floor, each above its number and its best return.

    Args:
        axes: axes to draw on.
        rows: rows of `coim.experiments.run.records.Record.designs`, at least one.
        body: the environment that the designs belong to.
    """
    env = body(num_runs=len(rows), reset_noise=0, seed=0)
    env.reset(TensorDict({"design": torch.tensor(designs_of(rows), dtype=torch.float32)}, [len(rows)]))
    left = 0.0
    for run, row in enumerate(rows_of(rows)):
        capsules = env.capsules(run).numpy()
        x, radius = capsules[:, [0, 2]], capsules[:, 4:]
        shift = left - float((x - radius).min())
        for x1, z1, x2, z2, r in capsules:
            draw_capsule(axes, (x1 + shift, z1), (x2 + shift, z2), r, KINDS[row["kind"]][0])
        right = shift + float((x + radius).max())
        axes.annotate(
            f"{row['design']}\n{number(row['best_return'], 3)}",
            ((left + right) / 2, 0), (0, -5), textcoords="offset points", ha="center", va="top",
        )  # fmt: skip
        left = right + GAP
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set(aspect="equal", ylabel="height (m)", xticks=[])
    axes.spines[["top", "right", "bottom"]].set_visible(False)


def draw_lines_of_bodies(lines: Sequence[tuple[str, pd.DataFrame]], body: type[MorphEnv]) -> Figure:
    """Several lines of bodies under each other, all to one scale.

    Args:
        lines: a title (may be empty) and the designs of each line.
        body: environment that the designs belong to.
    """
    figure = Figure(layout="constrained")
    grid = figure.subplots(len(lines), 1, squeeze=False)[:, 0]
    for axes, (title, rows) in zip(grid, lines):
        draw_bodies(axes, rows, body)
        axes.set_title(title, loc="left")
    put_legend(figure, kind_handles(kind for _, rows in lines for kind in rows["kind"]))
    right, top = (max(getattr(axes, name)()[1] for axes in grid) for name in ("get_xlim", "get_ylim"))
    for axes in grid:
        axes.set(xlim=(-GAP, right), ylim=(-0.05, top), anchor="W")
    inches = min(6.3 / (right + GAP), 1.4 / top)  # of a metre
    around = 0.75 if any(title for title, _ in lines) else 0.5  # words below and above a line
    figure.set_size_inches(7.2, 0.4 + len(lines) * (top * inches + around))
    return figure


def draw_capsule(axes: Axes, start: tuple[float, float], end: tuple[float, float], radius: float, colour: str) -> None:
    """A capsule's outline, filled; both half circles and the sides between them."""
    direction = np.arctan2(end[1] - start[1], end[0] - start[0])
    arc = np.linspace(np.pi / 2, 3 * np.pi / 2, 16) + direction
    back = np.stack([start[0] + radius * np.cos(arc), start[1] + radius * np.sin(arc)], 1)
    front = np.stack([end[0] - radius * np.cos(arc), end[1] - radius * np.sin(arc)], 1)
    axes.fill(*np.concatenate([back, front]).T, facecolor=colour, edgecolor="black", linewidth=0.6)
