"""Fig. 4(a): error of the learnt dynamics over training, on what they have seen and on what they have not.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Sec. 6.5 and Fig. 4(a).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from coim.experiments.drawing.curves import draw_mean, draw_runs
from coim.experiments.drawing.layout import STEPS, new_figure
from coim.experiments.drawing.palette import BLACK, BLUE, GREEN, GREY, ORANGE, VERMILION, put_legend
from coim.experiments.figures.plot import Plot, missing
from coim.experiments.frames import read_frame, rows_of
from coim.experiments.model_error.tables import (
    ERRORS,
    FOLDER,
    LAST,
    Kind,
    differences,
    errors,
    first_late_step,
    folders_with,
    late_share,
    mean_error,
    name_of,
    with_shares,
)
from coim.experiments.statistics.intervals import RESAMPLES
from coim.run_folder import read_config

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
    "share": "share of the change\nthat is not explained",
    "mse": "squared error, raw\n(m, rad, m/s, rad/s, squared)",
}
MOST = 3.0  # share up to which panels reach: first models err by hundreds, and would press the rest flat
STEM = "figure_4a_model_error"


def plots(study: Path) -> Iterator[Plot]:
    """Error over training for each kind of run that was measured, a panel for each model and each unit."""
    found = folders_with(study, ERRORS.file)
    if not found:
        line = f"coim model-error ENVIRONMENT --out {study / FOLDER}"
        yield missing(STEM, f"No model error was measured: {line}")
    for kind, folders in found.items():
        name = name_of(STEM, kind, found)
        rows = pd.concat([measured_in(folder, study) for folder in folders], ignore_index=True)
        if rows.empty:
            files = " and ".join(str(folder / ERRORS.file) for folder in folders)
            yield missing(name, f"There is no measurement yet in {files}.")
            continue
        yield Plot(
            name=name,
            figure=drawn(rows),
            rows=behind(rows),
            caption=caption(kind, rows),
            notes=notes(rows, folders),
            table=late_shares(rows),
        )


def measured_in(folder: Path, study: Path) -> pd.DataFrame:
    """What was measured in a folder, with its name and its seed."""
    seed = read_config(folder)["settings"].get("seed", 0)
    return with_shares(read_frame(folder / ERRORS.file, ERRORS), folder.relative_to(study).as_posix(), seed)


def drawn(rows: pd.DataFrame) -> Figure:
    """A line of panels for each unit, a column for each model."""
    figure, grid = new_figure(6.4, len(UNITS), len(MODELS), sharex=True)
    panels = iter(grid)
    for unit, words in UNITS.items():
        pair = [next(panels) for _ in MODELS]
        for axes, (model, title) in zip(pair, MODELS.items()):
            draw(axes, rows, model, unit)
            axes.set(title=title if unit == "share" else "")
        low, high = (f(axes.get_ylim()[i] for axes in pair) for i, f in enumerate((min, max)))
        for axes in pair:
            axes.set(ylim=(low, min(high, MOST) if unit == "share" else high))
        pair[0].set(ylabel=words)
    for axes in grid[-len(MODELS) :]:
        axes.set(xlabel=STEPS)
    put_legend(figure, list(handles({*rows["probe"]})))
    return figure


def draw(axes: Axes, rows: pd.DataFrame, model: str, unit: str) -> None:
    """One model in one unit: for each probe the mean over runs, with its interval and the runs where there are several.

    The mean's line has the probe's name as its label.
    """
    for probe, (colour, dashes, mark, _) in PROBES.items():
        found = errors(rows, probe, model, unit)
        style: dict[str, Any] = {"color": colour, "linestyle": dashes or "none", "marker": mark}
        if len(found.y) > 1:
            draw_runs(axes, found.x, found.y, label=f"_{probe}", markersize=2.5, **style)
        x, value, low, high, _ = mean_error(rows, probe, model, unit)
        draw_mean(axes, x, value, low, high, label=probe, markersize=4, linewidth=1.3, **style)
    if unit == "share":
        axes.axhline(1, label="no change", color=GREY, linestyle="--", linewidth=1)
    axes.set(yscale="log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if unit == "share" else (1, 3), numticks=20))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.xaxis.set_major_formatter("{x:,.0f}")


def handles(measured: set[str]) -> Iterator[Line2D]:
    """Entries of the legend for what was measured."""
    for probe, (colour, dashes, mark, words) in PROBES.items():
        if probe in measured:
            style: dict[str, Any] = {"linestyle": dashes or "none", "marker": mark}
            yield Line2D([], [], color=colour, markersize=4, label=words, **style)
    yield Line2D([], [], color=GREY, linestyle="--", linewidth=1, label="predicting no change")


def behind(rows: pd.DataFrame) -> list[dict[str, object]]:
    """The CSV file: the rows of every run, and where there are several the mean and its interval at each step."""
    ends = [f"{unit}_{end}" for unit in UNITS for end in ("low", "high")]
    nothing = dict.fromkeys([*rows.columns, *ends], "")
    found = [{"series": "run", **nothing, **row, "runs": 1} for row in rows_of(rows)]
    if len(names_of(rows)) == 1:
        return found
    for probe in PROBES:
        for model in MODELS:
            means: dict[int, dict[str, object]] = {}
            for unit in UNITS:
                for step, value, low, high, count in zip(*mean_error(rows, probe, model, unit)):
                    numbers = {unit: value, f"{unit}_low": low, f"{unit}_high": high, "runs": int(count)}
                    means.setdefault(int(step), {}).update(numbers)
            head = {"series": "mean", **nothing, "probe": probe, "predict": model}
            found += [head | {"env_steps": step} | numbers for step, numbers in sorted(means.items())]
    return found


def names_of(rows: pd.DataFrame) -> set[tuple[object, object]]:
    """Folder and number of each run."""
    return {*rows[["folder", "run"]].itertuples(index=False, name=None)}


def caption(kind: Kind, rows: pd.DataFrame) -> str:
    """What is drawn."""
    runs = len(names_of(rows))
    words = (
        f"Squared error of the model's mean prediction on {kind.environment}, {kind.task}, {kind.designs} designs, "
        f"{runs} run{'s' * (runs > 1)}. Above: as a share of the error of predicting no change; at 1 a model knows "
        "nothing of the change. Below: in raw units."
    )
    if runs > 1:
        words += (
            " Faint: single runs. Strong: their mean. Bands and bars: pointwise 95 % bootstrap intervals over runs."
        )
    return words


def notes(rows: pd.DataFrame, folders: Sequence[Path]) -> list[str]:
    """How the errors were measured and joined."""
    found = [
        "Both models learn from the same batches. Models are tested on transitions that they do not learn from.",
        "Designs seen: one more episode of each design, by the individual policy that learnt on it. Next design and "
        "designs never built: episodes by the population's policy of that time. So these differ from designs seen in "
        "their bodies and in their policies.",
        "Share: each entry of the observation counts in units of the variance of its one-step changes in the replay, "
        f"and the error of predicting no change is that on the same transitions. Panels end at {MOST:g}.",
        "Raw error: in the units of the observation, as in the paper. It is smaller where the states move less.",
        "A run that diverges is measured until then.",
    ]
    if len(names_of(rows)) > 1:
        found += of_several(rows, folders)
    found.append(
        f"The table has the shares over the last {LAST:.0%} of training (after step {first_late_step(rows):,}): the "
        "sum of a run's errors over the sum of those of predicting no change, as a mean over runs with its 95 % "
        "interval where there are several."
    )
    return found


def late_shares(rows: pd.DataFrame) -> list[dict[str, object]]:
    """Share of the change that is not explained at the end of training, for all that was measured by each model."""
    table: list[dict[str, object]] = []
    for probe, (*_, words) in PROBES.items():
        found = {model: late_share(rows, probe, model) for model in MODELS}
        if any(np.isfinite(value) for value, _, _ in found.values()):
            row: dict[str, object] = {"transitions": words}
            table.append(row | {MODELS[model]: in_words(*share) for model, share in found.items()})
    return table


def in_words(value: float, low: float, high: float) -> str:
    """A number, with its interval where there is one."""
    return f"{value:.3g}" + (f" ({low:.3g} to {high:.3g})" if np.isfinite(low) else "")


def of_several(rows: pd.DataFrame, folders: Sequence[Path]) -> list[str]:
    """Notes on how runs were joined."""
    found = [f"The bootstrap has {RESAMPLES} resamples."]
    every = [errors(rows, probe, model, "mse") for probe in PROBES for model in MODELS]
    if any(one.shared.x.size < one.x.size for one in every):
        found.append("The mean is drawn at the steps at which all runs that had got so far have a number.")
    if different := differences(folders):
        found.append(f"The runs differ in more than their seed: {', '.join(different)}.")
    return found
