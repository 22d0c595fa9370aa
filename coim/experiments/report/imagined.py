"""Section of the page on what was imagined: pairs that cannot be, and how much a governor allowed and why."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from coim.experiments.drawing.layout import STEPS, new_figure
from coim.experiments.drawing.palette import GREY, ORANGE, VERMILION
from coim.experiments.frames import curves
from coim.experiments.report.axes import explain, mark_builds, plot_over_steps, points_in_words
from coim.experiments.report.page import Section
from coim.experiments.run.records import Record
from coim.governor import EARNED, UNEARNED
from coim.pairs import IN_THE_FLOOR

FORBIDDEN = {  # why a governor allowed nothing: the colour of its mark, and what the legend says
    "error": (VERMILION, "nothing: error too high"),
    "disagreement": (ORANGE, "nothing: members disagree"),
}


def imagination(records: Sequence[Record]) -> Section | None:
    """Share of impossible pairs of every run that imagines, and the governed shares; None where nothing is imagined."""
    title = "What was imagined"
    imagining = [record for record in records if record.settings.get("imagine", "none") != "none"]
    if not imagining:
        return None
    counted = any("impossible" in record.episodes for record in imagining)
    told = [_judged(record) for record in records]
    governed = [record for record in told if "reason" in record.episodes]
    notes = [*_uncounted(imagining, several=len(records) > 1), *_reasons(governed, several=len(records) > 1)]
    if not counted and not governed:
        return Section(title=title, notes=notes)
    panels = counted + 2 * bool(governed)
    figure, grid = new_figure(0.9 + 1.5 * panels, panels, 1, sharex=True)
    caption = ""
    if counted:
        plot_over_steps(grid[0], records, "impossible")
        grid[0].set(ylabel="impossible\npairs (share)", ylim=(-0.02, 1.02))
        caption += f"Share of imagined pairs with over {100 * IN_THE_FLOOR:.0f} cm of the body in the floor."
    if governed:
        above, below = grid[-2:]
        _draw_error(above, told)
        _draw_share(below, told)
        caption += (
            " The model's error on the body's first or on the latest episode, the larger one: above the upper line "
            "nothing is imagined, below the lower one the whole share. Last: share of a batch that is imagined; "
            "crosses: nothing."
        )
    if len(records) == 1:
        for axes in grid:
            mark_builds(axes, records[0])
    grid[-1].set(xlabel=STEPS)
    reasons = {reason for record in governed for reason in record.episodes["reason"]}
    marks = [
        Line2D([], [], color=colour, marker="x", linestyle="", label=words)
        for reason, (colour, words) in FORBIDDEN.items()
        if reason in reasons
    ]
    explain(figure, records, more=marks)
    ends = [
        f"{record.name}: {found[-1]:.3g}"
        for record in imagining
        if (found := curves(record.episodes, "env_steps", "impossible").mean).size
    ]
    alt = "Shares over training steps. Impossible pairs in the last episode: " + ("; ".join(ends) or "not counted")
    return Section(
        title=title,
        figure=figure,
        caption=caption.strip(),
        alt=f"{alt}. {' '.join(notes)}",
        notes=[*notes, *points_in_words(records)],
    )


def judged(episodes: pd.DataFrame) -> pd.DataFrame:
    """Episodes of governed runs with the error that counted and the reason for what was allowed.

    Args:
        episodes: rows with ``run``, ``design``, ``episode``, ``model_error`` and ``imagined_share``.

    Returns:
        The rows with ``counting_error``, the larger error of the design's first and of this episode (see
        `coim.Governor`), and ``reason``: "earned" where something was imagined; where nothing was, "error" if that
        error alone forbids it, "disagreement" otherwise.

    Example:
        >>> rows = pd.DataFrame({"run": 0, "design": [1, 1, 2], "episode": [1, 2, 1],
        ...                      "model_error": [0.8, 0.2, 0.3], "imagined_share": [0.0, 0.0, 0.0]})
        >>> judged(rows)["reason"].tolist()
        ['error', 'error', 'disagreement']
    """
    place = ["run", "design"]
    first = episodes[episodes["episode"] == 1].drop_duplicates(place, keep="last").set_index(place)["model_error"]
    of_design = first.reindex(pd.MultiIndex.from_frame(episodes[place])).to_numpy()
    error = np.maximum(of_design, episodes["model_error"].to_numpy())  # NaN stays, and earns nothing
    why = np.where(error < UNEARNED, "disagreement", "error")
    reason = np.where(episodes["imagined_share"] > 0, "earned", why)
    return episodes.assign(counting_error=error, reason=reason)


def _judged(record: Record) -> Record:
    """A governed run's record with what `judged` adds; others as they are."""
    if "imagined_share" not in record.episodes:
        return record
    return replace(record, episodes=judged(record.episodes[np.isfinite(record.episodes["imagined_share"])]))


def _draw_error(axes: Axes, records: Sequence[Record]) -> None:
    plot_over_steps(axes, records, "counting_error")
    for level in (UNEARNED, EARNED):
        axes.axhline(level, color=GREY, linestyle="--", linewidth=0.8, zorder=0)
    axes.set(ylabel="error that counts\n(variances)", yscale="log")
    axes.yaxis.set(major_locator=LogLocator(subs=(1, 2, 5)), minor_formatter=NullFormatter())
    axes.yaxis.set_major_formatter("{x:g}")


def _draw_share(axes: Axes, records: Sequence[Record]) -> None:
    plot_over_steps(axes, records, "imagined_share")
    governed = [record for record in records if "reason" in record.episodes]
    for record in governed:
        for reason, (colour, _) in FORBIDDEN.items():
            rows = record.episodes[record.episodes["reason"] == reason]
            axes.scatter(rows["env_steps"], np.zeros(len(rows)), s=16, color=colour, marker="x", zorder=4)
    names = ("imagined_share", "individual_imagined_share")
    most = max(record.settings.get(name, 0.0) for record in governed for name in names) or 1.0
    axes.set(ylabel="imagined share\nof a batch", ylim=(-0.06 * most, 1.06 * most))


def _reasons(governed: Sequence[Record], *, several: bool) -> Iterator[str]:
    """A sentence for each run on how often its model had earned imagination, and why not."""
    for record in governed:
        for run, rows in record.episodes.groupby("run"):
            counts = rows["reason"].value_counts()
            shares = rows["imagined_share"][rows["reason"] == "earned"]
            prefix = f"{record.name}: " if several else ""
            imagined = "nothing was imagined"
            if len(shares):
                imagined = f"{shares.min():.2g} to {shares.max():.2g} of a batch in {len(shares)}"
            yield (
                f"{prefix}run {run}: of {len(rows)} episodes {imagined}; the error was {UNEARNED} or more in "
                f"{counts.get('error', 0)}, the members disagreed on most rows in {counts.get('disagreement', 0)}."
            )


def _uncounted(imagining: Sequence[Record], *, several: bool) -> Iterator[str]:
    """A sentence for each folder whose impossible pairs were not counted."""
    for record in imagining:
        if "impossible" not in record.episodes:
            prefix = f"{record.name}: " if several else ""
            yield f"{prefix}impossible pairs were not counted: an earlier version, or a body whose height is not known."
