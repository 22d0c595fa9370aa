"""The picture at the end of a run: best return of each design, and the bodies beside each other."""

from __future__ import annotations

import csv
from collections import defaultdict
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tensordict import TensorDict

from coim import MorphEnv

# Okabe and Ito's palette: its contrasts survive the common kinds of colour blindness. Shapes tell the kinds apart too.
KINDS = {"first": ("#0072B2", "o"), "optimised": ("#D55E00", "^"), "random": ("#009E73", "s")}
BODIES_SHOWN = 8


def draw_run(folder: Path, body: type[MorphEnv]) -> Path:
    """Draw what ``designs.csv`` holds.

    Args:
        folder: of the run.
        body: what the designs belong to.

    Returns:
        ``figures/designs.png`` in the folder.
    """
    rows = read_designs(folder / "designs.csv")
    figure, (returns, bodies) = plt.subplots(2, 1, figsize=(9, 7), height_ratios=[3, 2], layout="constrained")
    plot_best_returns(returns, rows)
    draw_bodies(bodies, [row for row in rows if row["run"] == rows[0]["run"]], body)
    path = folder / "figures" / "designs.png"
    save(figure, path)
    return path


def read_designs(path: Path) -> list[dict]:
    """Rows of ``designs.csv`` with numbers as numbers and the design as one tuple."""
    with path.open(newline="") as file:
        return [
            {
                "run": int(row["run"]),
                "design": int(row["design"]),
                "kind": row["kind"],
                "xi": tuple(float(value) for key, value in row.items() if key.startswith("xi_")),
                "best_return": float(row["best_return"]),
            }
            for row in csv.DictReader(file)
        ]


def plot_best_returns(axes: Axes, rows: list[dict]) -> None:
    """Best return over design index; each run a faint line, their mean a black one, kinds by colour and shape."""
    by_run: dict[int, list[tuple[int, float]]] = defaultdict(list)
    for row in rows:
        by_run[row["run"]].append((row["design"], row["best_return"]))
    for points in by_run.values():
        axes.plot(*zip(*points), color="#999999", linewidth=0.8, zorder=1)
    for kind, (colour, marker) in KINDS.items():
        points = [(row["design"], row["best_return"]) for row in rows if row["kind"] == kind]
        if points:
            axes.scatter(*zip(*points), color=colour, marker=marker, label=f"{kind} design", zorder=2)
    axes.set(xlabel="design (number)", ylabel="best return of a design (1)")
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)


def draw_bodies(axes: Axes, rows: list[dict], body: type[MorphEnv]) -> None:
    """The bodies of one run at rest, to one scale; of many, the best ones, in the order they were built."""
    best = sorted(rows, key=lambda row: row["best_return"], reverse=True)[:BODIES_SHOWN]
    shown = sorted(best, key=lambda row: row["design"])
    env = body(num_runs=len(shown), reset_noise=0, seed=0)
    env.reset(TensorDict({"design": torch.tensor([row["xi"] for row in shown])}, [len(shown)]))
    left = 0.0
    for run, row in enumerate(shown):
        capsules = env.capsules(run).numpy()
        x, radius = capsules[:, [0, 2]], capsules[:, 4:]
        shift = left - float((x - radius).min())
        for x1, z1, x2, z2, r in capsules:
            draw_capsule(axes, (x1 + shift, z1), (x2 + shift, z2), r, KINDS[row["kind"]][0])
        right = shift + float((x + radius).max())
        axes.annotate(
            f"{row['design']}\n{row['best_return']:.3g}", ((left + right) / 2, 0), (0, -14), ha="center", va="top",
            textcoords="offset points",
        )  # fmt: skip
        left = right + 0.3
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set(aspect="equal", ylabel="height (m)", xticks=[], title="bodies at rest: number of the design, best return")
    axes.spines[["top", "right", "bottom"]].set_visible(False)


def draw_capsule(axes: Axes, start: tuple[float, float], end: tuple[float, float], radius: float, colour: str) -> None:
    """A capsule's outline, filled; both half circles and the sides between them."""
    direction = np.arctan2(end[1] - start[1], end[0] - start[0])
    arc = np.linspace(np.pi / 2, 3 * np.pi / 2, 16) + direction
    back = np.stack([start[0] + radius * np.cos(arc), start[1] + radius * np.sin(arc)], 1)
    front = np.stack([end[0] - radius * np.cos(arc), end[1] - radius * np.sin(arc)], 1)
    axes.fill(*np.concatenate([back, front]).T, facecolor=colour, edgecolor="black", linewidth=0.6)


def save(figure: Figure, path: Path) -> None:
    """Write a figure and free it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    plt.close(figure)
