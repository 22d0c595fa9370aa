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
from coim.envs.camera import drawn_axes
from coim.experiments.drawing.palette import KINDS, kind_handles, put_legend
from coim.experiments.frames import designs_of, rows_of
from coim.experiments.run.records import number

GAP = 0.3  # m between two bodies
BODIES_IN_A_LINE = 8


def draw_bodies(axes: Axes, rows: pd.DataFrame, body: type[MorphEnv]) -> None:
    """Draw designs from left to right on one floor, each above its number and its best return.

    Robots with a free root are seen a little from above and behind, without a floor.

    Args:
        axes: axes to draw on.
        rows: rows of `coim.experiments.run.records.Record.designs`, at least one.
        body: the environment that the designs belong to.
    """
    env = body(num_runs=len(rows), reset_noise=0, seed=0)
    env.reset(TensorDict({"design": torch.tensor(designs_of(rows), dtype=torch.float32)}, [len(rows)]))
    from_the_side = env.root.kind != "free"
    left = 0.0
    for run, row in enumerate(rows_of(rows)):
        capsules = seen(env.capsules(run).numpy(), drawn_axes(env.root))
        x, radius = capsules[:, [0, 2]], capsules[:, 4:]
        shift = left - float((x - radius).min())
        # Seen from above, feet before the robot are lower in the picture than the ground under it.
        rise = 0.0 if from_the_side else -float((capsules[:, [1, 3]] - radius).min())
        for x1, z1, x2, z2, r in capsules:
            draw_capsule(axes, (x1 + shift, z1 + rise), (x2 + shift, z2 + rise), r, KINDS[row["kind"]][0])
        right = shift + float((x + radius).max())
        axes.annotate(
            f"{row['design']}\n{number(row['best_return'], 3)}",
            ((left + right) / 2, 0), (0, -5), textcoords="offset points", ha="center", va="top",
        )  # fmt: skip
        left = right + GAP
    if from_the_side:
        axes.axhline(0, color="black", linewidth=0.8)
    axes.set(aspect="equal", ylabel="height (m)" if from_the_side else "m", xticks=[])
    axes.spines[["top", "right", "bottom"]].set_visible(False)


def seen(capsules: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Capsules in a parallel projection, the farthest first.

    Args:
        capsules: as `coim.envs.MorphEnv.capsules` has them, ``[G, 7]``.
        axes: directions right, up and towards the viewer, ``[3, 3]``, see `coim.envs.camera.drawn_axes`.

    Returns:
        Right and up of both ends, and the radius, in m, ``[G, 5]``.

    Example:
        >>> seen(np.array([[1.0, 5.0, 2.0, 3.0, 5.0, 2.0, 0.1]]), np.eye(3)[[0, 2, 1]]).tolist()
        [[1.0, 2.0, 3.0, 2.0, 0.1]]
    """
    start, end = (capsules[:, at : at + 3] @ axes.T for at in (0, 3))
    flat = np.hstack([start[:, :2], end[:, :2], capsules[:, 6:]])
    return flat[np.argsort(start[:, 2] + end[:, 2], kind="stable")]


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
