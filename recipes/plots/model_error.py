"""Fig. 4(a): error of the learnt dynamics over training, on what they have seen and on what they have not.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Sec. 6.5 and Fig. 4(a).
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from recipes.plots.plot import Plot, missing
from recipes.probing.probed import FILE
from recipes.reporting.curves import STEPS, new_figure
from recipes.reporting.palette import BLACK, BLUE, GREEN, GREY, ORANGE, VERMILION, put_legend
from recipes.settings import read_config

FOLDER = "model_error"  # of a study
Row = dict[str, str]

# Colour, dashes, mark and words of each thing that is measured.
PROBES = {
    "seen": (VERMILION, "-", "", "designs seen, held-out episodes"),
    "next": (BLACK, "", "^", "next design before it is learnt on"),
    "never built": (BLUE, "-", "", "designs never built, own episodes"),
    "noisy": (ORANGE, "-", "", "stored states, noisy designs"),
    "noisy possible": (ORANGE, ":", "", "noisy designs, not in the floor"),
    "random": (GREEN, "-", "", "stored states, random designs"),
    "random possible": (GREEN, ":", "", "random designs, not in the floor"),
}
MODELS = {"delta": "learns the change", "next": "learns the next observation"}
UNITS = {
    "normalised": "squared error\n(variances of one-step changes, 1)",
    "mse": "squared error, raw\n(m, rad, m/s, rad/s, squared)",
}


def folders_with(study: Path, file: str) -> list[Path]:
    """Folders of a study that `recipes.model_error` has written a file into."""
    return sorted(path.parent for path in (study / FOLDER).rglob(file))


def read(path: Path) -> list[Row]:
    """Rows of a CSV file."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def plots(study: Path) -> Iterator[Plot]:
    """Error over training for each environment that was measured, a panel for each model and each unit."""
    folders = folders_with(study, FILE)
    if not folders:
        line = f"python -m recipes.model_error ENVIRONMENT --out {study / FOLDER}"
        yield missing("figure_4a_model_error", f"No model error was measured: {line}")
    for folder in folders:
        environment, rows = read_config(folder)["environment"], read(folder / FILE)
        if not rows:
            yield missing(f"figure_4a_model_error_{environment}", f"{folder / FILE} has no measurement yet.")
            continue
        figure, grid = new_figure(6.4, len(UNITS), len(MODELS), sharex=True)
        panels = iter(grid)
        for unit, words in UNITS.items():
            pair = [next(panels) for _ in MODELS]
            for axes, (model, title) in zip(pair, MODELS.items()):
                draw(axes, rows, model, unit)
                axes.set(title=title if unit == "normalised" else "")
            low, high = (f(axes.get_ylim()[i] for axes in pair) for i, f in enumerate((min, max)))
            for axes in pair:
                axes.set(ylim=(low, high))
            pair[0].set(ylabel=words)
        for axes in grid[-len(MODELS) :]:
            axes.set(xlabel=STEPS)
        measured = {row["probe"] for row in rows}
        put_legend(figure, list(handles(measured)))
        caption = describe(environment, rows)
        yield Plot(name=f"figure_4a_model_error_{environment}", figure=figure, rows=rows, caption=caption)


def draw(axes: Axes, rows: Sequence[Row], model: str, unit: str) -> None:
    """One model in one unit: a line for each probe (the mean over runs), grey where nothing is predicted to change."""
    for probe, (colour, dashes, mark, _) in PROBES.items():
        x, y = means(rows, probe, model, unit)
        lone = mark or ("o" if len(x) == 1 else "")
        axes.plot(x, y, color=colour, linestyle=dashes or "none", marker=lone, markersize=4, linewidth=1.3)
    axes.plot(*means(rows, "seen", "nothing", unit), color=GREY, linestyle="--", linewidth=1)
    axes.set(yscale="log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 3), numticks=20))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.xaxis.set_major_formatter("{x:,.0f}")


def means(rows: Sequence[Row], probe: str, model: str, unit: str) -> tuple[np.ndarray, np.ndarray]:
    """Training steps, and the mean over runs at each of them where all are numbers."""
    found: dict[int, list[float]] = {}
    for row in rows:
        if (row["probe"], row["predict"]) == (probe, model):
            found.setdefault(int(row["env_steps"]), []).append(float(row[unit]))
    return np.array(list(found)), np.array([np.mean(values) for values in found.values()])


def handles(measured: set[str]) -> Iterator[Line2D]:
    """Entries of the legend for what was measured."""
    for probe, (colour, dashes, mark, words) in PROBES.items():
        if probe in measured:
            yield Line2D([], [], color=colour, linestyle=dashes or "none", marker=mark, markersize=4, label=words)
    yield Line2D([], [], color=GREY, linestyle="--", linewidth=1, label="predicting no change, designs seen")


def describe(environment: str, rows: Sequence[Row]) -> str:
    """What is seen, with the last error of each probe."""
    runs = len({row["run"] for row in rows})
    last = []
    for model, words in MODELS.items():
        values = {probe: means(rows, probe, model, "normalised")[1][-1:] for probe in PROBES}
        told = ", ".join(f"{probe} {value[0]:.3g}" for probe, value in values.items() if len(value))
        last.append(f"a model that {words}: {told}")
    return (
        f"Squared error of the ensemble's mean prediction on {environment}, {runs} run(s), over training; both models "
        "learn from the same batches. Seen: one more episode of each design, by the policy that learnt on it; next "
        "and never built: episodes by the population's policy of that time. Runs that diverge are measured until then. "
        "Above in variances of one-step changes in the replay, below in the raw units of "
        f"the observation, as the paper prints it. At the end, in variances, {'; '.join(last)}."
    )
