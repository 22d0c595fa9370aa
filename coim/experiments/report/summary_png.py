"""The picture at the end of a run: best return of each design, and the bodies beside each other."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from coim.envs import MorphEnv
from coim.experiments.drawing.bodies import draw_bodies
from coim.experiments.drawing.layout import lay_out
from coim.experiments.report.axes import cross_handles, explain, plot_over_designs
from coim.experiments.run.atomic_write import written_aside
from coim.experiments.run.records import read_record

BODIES_SHOWN = 8


def draw_run(folder: Path, body: type[MorphEnv]) -> Path:
    """Draw the best returns and the best bodies of a run.

    Args:
        folder: a run folder.
        body: environment that the designs belong to.

    Returns:
        ``figures/designs.png`` in the folder.
    """
    record = read_record(folder, folder.name)
    figure, (returns, bodies) = plt.subplots(2, 1, figsize=(9, 7), height_ratios=[3, 2], layout="constrained")
    plot_over_designs(returns, [record], "best_return")
    returns.set(xlabel="design (number)", ylabel="best return of a design")
    returns.spines[["top", "right"]].set_visible(False)
    explain(figure, [record], kinds=True, more=cross_handles([record]))
    # The best run's, as on the page: the first run may have diverged before it had many.
    run = record.best["best_return"].idxmax() if len(record.best) else record.designs["run"].iloc[0]
    own = record.designs[record.designs["run"] == run]
    best = own.sort_values("best_return", kind="stable").tail(BODIES_SHOWN)
    draw_bodies(bodies, best.sort_values("design"), body)
    whose = f" of run {run}" if record.num_runs > 1 else ""
    bodies.set_title(f"bodies{whose} at rest: number of the design, best return")
    path = folder / "figures" / "designs.png"
    save(figure, path)
    return path


def save(figure: Figure, path: Path) -> None:
    """Write a figure and free it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_aside(path) as aside:
        lay_out(figure).savefig(aside, dpi=150)
    plt.close(figure)
