"""Fig. 2: returns of the best designs that Eq. 5 chose in each arm, retrained from scratch."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from coim.experiments.figures.figure import Plot, missing
from coim.experiments.run.records import number
from coim.experiments.statistics import retrained as retrained_pairs
from coim.experiments.statistics.retrained import Cells, Line, by_place, results, sizes
from coim.experiments.study.arms import arm_named
from coim.experiments.study.runs import CHOSEN, Runs, read_runs
from coim.tables import read_cells

NAME = "figure_2_retrained"


def plots(study: Path) -> Iterator[Plot]:
    """The designs and the tests between arms, from what `coim.experiments.commands.retrain` wrote."""
    path, command = study / "retrained" / "designs.csv", f"coim retrain {study}"
    if not path.is_file():
        yield from nothing(f"No design was retrained: {command}.")
        return
    listed = read_cells(path, CHOSEN)
    rows, lost = results(path.parent, listed)
    if not rows:
        diverged = f"; {lost} diverged before their first return" if lost else ""
        yield from nothing(f"None of {len(listed)} designs is retrained yet: {command}{diverged}.")
        return
    table = retrained_pairs.pairs(rows)
    yield draw(rows, f"{caption(rows, listed, lost)} {early(read_runs(study), listed)}{told(rows, table)}")
    yield retrained_pairs.draw(table)


def nothing(words: str) -> Iterator[Plot]:
    """Instead of both figures."""
    yield missing(NAME, words)
    yield missing(retrained_pairs.NAME, words)


def early(runs: Runs, listed: Sequence[Line]) -> str:
    """Whose designs were chosen before all runs were over that the study plans by now, in words."""
    chosen = {(line["environment"], line["task"], line["arm"]): line.get("over") for line in listed}
    words = [
        f"{', '.join(which)}: {over} of {runs.planned[which]}"
        for which, over in chosen.items()
        if over and int(over) < runs.planned[which]
    ]
    if not words:
        return ""
    return f"Chosen before all runs were over ({'; '.join(words)} planned now); designs of the others had no chance. "


def caption(rows: Sequence[Cells], listed: Sequence[Line], lost: int) -> str:
    """What is drawn, and which rules applied."""
    episodes, in_study = (
        " or ".join(str(count) for count in sorted({int(str(row[name])) for row in rows}))
        for name in ("episodes", "study_episodes")
    )
    diverged, replaced = (sum(bool(row[name]) for row in rows) for name in ("diverged", "replaced"))
    words = (
        f"Highest return of the deterministic policy of plain SAC in {episodes} training episodes from scratch on each "
        "of the best designs that Eq. 5 chose in each run, by their return in the study, where such a design had "
        f"{in_study} episodes; first and random designs are left out, even where they were better. Boxes: quartiles "
        "and median; whiskers: all designs; points: designs, each with a seed of its own, also where a body comes "
        f"again. {len(rows) + lost} of {len(listed)} designs are retrained, {diverged + lost} of them diverged"
    )
    if diverged > replaced:
        words += "; these count with the best return until then"
    if replaced:
        words += f"; {replaced} without a return until then: counts with the lowest best return of its place"
    if lost:
        words += f"; {lost} left out, as no retraining of their environment and task has a return"
    return f"{words}."


def told(rows: Sequence[Cells], table: Sequence[Cells]) -> str:
    """Where the designs of each arm come from, and how the arms differ."""
    sentences = []
    for place, own in by_place(rows).items():
        arms = "; ".join(origin(arm, designs) for arm, designs in own.items())
        sentences.append(f"{', '.join(place)}: {arms}.{' ' + UNEQUAL if unequal(own) else ''}")
    sentences += [compared(row) for row in table]
    if table:
        sentences.append("Designs of one run are not independent, as the test over designs takes them to be.")
    return " ".join(sentences)


UNEQUAL = "The shares differ, which favours the arm with the smaller one."


def origin(arm: str, designs: Sequence[Cells]) -> str:
    """Of one arm's designs."""
    counts, first = sizes(designs), designs[0]
    words = f"{arm}: {counts['designs']} designs, distinct bodies {counts['bodies']}, runs {counts['runs']}"
    if not first["found"]:
        return words
    found, kept = int(str(first["found"])), int(str(first["kept"]))
    return f"{words}, chosen as the best of each run, {kept} of {found} ({100 * kept / found:.0f} %)"


def unequal(own: dict[str, list[Cells]]) -> bool:
    """Whether no one share, rounded up to whole designs of each run, gives the number that was kept of each arm."""
    counts = [
        (int(str(rows[0]["kept"])), int(str(rows[0]["found"])), sizes(rows)["runs"])
        for rows in own.values()
        if rows[0]["found"]
    ]
    least = min((kept / found for kept, found, _ in counts), default=math.inf)
    return any((kept - runs) / found >= least for kept, found, runs in counts)


def compared(row: Cells) -> str:
    """A pair of arms in words."""
    difference, low, high = (float(str(row[f"difference{end}"])) for end in ("", "_low", "_high"))
    words = "{environment}, {task}: {arm} minus {against} ".format(**row) + number(difference, 3)
    if math.isfinite(low):
        words += f" (95 % interval over runs {number(low, 3)} to {number(high, 3)})"
    designs, runs = (float(str(row[name])) for name in retrained_pairs.TESTS)
    over_designs = f"p = {designs:.2g}" if math.isfinite(designs) else "too few designs for a test"
    over_runs = f"p = {runs:.2g}" if math.isfinite(runs) else "too few runs for a test"
    return f"{words}, Welch's t-test over designs, as in the paper: {over_designs}; over one mean per run: {over_runs}."


def draw(rows: Sequence[Cells], words: str) -> Plot:
    """A panel for each environment and task."""
    places = by_place(rows)
    widths = [max(2.6, 0.6 + 0.75 * len(own)) for own in places.values()]  # inches, with room for the names of arms
    figure = Figure(figsize=(max(3.6, sum(widths)), 3.4), layout="constrained")
    panels = figure.subplots(1, len(places), squeeze=False, width_ratios=widths)[0]
    for axes, (place, own) in zip(panels, places.items()):
        draw_panel(axes, {arm: np.array([row["best_return"] for row in rows], float) for arm, rows in own.items()})
        axes.set(title=", ".join(place), ylabel="best return, retrained from scratch (1)")
    return Plot(name=NAME, figure=figure, rows=rows, caption=words)


def draw_panel(axes: Axes, values: dict[str, np.ndarray]) -> None:
    """Boxes and points of each arm."""
    for x, (arm, returns) in enumerate(values.items()):
        colour = arm_named(arm).colour
        axes.boxplot(
            returns, positions=[x], widths=0.5, whis=(0, 100), patch_artist=True,
            boxprops={"facecolor": colour, "alpha": 0.25, "edgecolor": colour},
            medianprops={"color": colour, "linewidth": 1.6}, whiskerprops={"color": colour}, capprops={"color": colour},
        )  # fmt: skip
        spread = x + np.linspace(-0.18, 0.18, len(returns) + 2)[1:-1]
        axes.scatter(spread, returns, s=14, zorder=3, **arm_named(arm).point)
    axes.set(xticks=range(len(values)), xticklabels=[f"{arm}\nn = {len(v)}" for arm, v in values.items()])
    axes.spines[["top", "right"]].set_visible(False)
