"""Sections of the page on the learning of a run, or of several runs that are compared: one function each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from coim.envs import MorphEnv
from coim.episode import run_episode
from coim.experiments.drawing.layout import STEPS, new_figure
from coim.experiments.drawing.palette import BLACK, BLUE, GREY, SKY, style_of
from coim.experiments.frames import curves, designs_of
from coim.experiments.report.axes import (
    cross_handles,
    episodes_in_a_point,
    explain,
    mark_builds,
    mark_divergences,
    plot_curves,
    plot_over_steps,
    points_in_words,
)
from coim.experiments.report.page import Section
from coim.experiments.run.records import Record, number

RANDOM_EPISODES = 4
LOSSES = {  # column of metrics.csv behind the learner's name, and the words beside its axis
    "loss_actor": "actor loss",
    "loss_qvalue": "critic loss",
    "alpha_entropy": r"$\alpha\,\times$ entropy (nats)",
    "loss_dynamics": "model loss, Eq. 6",
}


def learning_curves(records: Sequence[Record], body: type[MorphEnv] | None) -> Section:
    """Return over training steps, and that of random actions."""
    figure, (axes,) = new_figure(3.4)
    caption = "Return of the deterministic policy after each training episode."
    by_chance, lines = "", []
    if body is not None and len({_what_chance_meets(record) for record in records}) == 1:
        level = random_return(records[0], body)
        lines = [axes.axhline(level, color=GREY, linestyle=":", label="random actions on the first body")]
        by_chance = f" Random actions on the first body: {number(level)}."
    if len(records) == 1:
        mark_builds(axes, records[0])
        sampled = curves(records[0].episodes, "env_steps", "training_return").averaged(episodes_in_a_point(records[0]))
        plot_curves(axes, sampled, faint=False, color=SKY, linestyle="-", label="training episode, sampled actions")
        plot_over_steps(axes, records, "return", prefix="evaluation episode, deterministic actions")
        handles, _ = axes.get_legend_handles_labels()
        explain(figure, records, mean=False, more=[*handles, *cross_handles(records)])
        caption += " Upright lines: the next body. Faint lines: single runs, where there are several."
    else:
        plot_over_steps(axes, records, "return")
        explain(figure, records, more=[*lines, *cross_handles(records)])
    for record in records:
        mark_divergences(axes, record.diverged, "env_steps", "return")
    axes.set(xlabel=STEPS, ylabel="return of an episode")
    last = [f"{r.name}: {curves(r.episodes, 'env_steps', 'return').mean[-1:].round(2).tolist()}" for r in records]
    return Section(
        title="Learning curves",
        figure=figure,
        caption=caption,
        alt="Return over training steps. Last mean: " + "; ".join(last) + f".{by_chance}",
        notes=points_in_words(records),
    )


def _what_chance_meets(record: Record) -> tuple[object, ...]:
    """What the return of random actions depends on: first bodies, task, and steps of an episode."""
    first = record.designs[record.designs["design"] == record.designs["design"].min()]
    bodies = {tuple(design) for design in designs_of(first).tolist()}
    return (frozenset(bodies), *(record.settings.get(name) for name in ("task", "episode_steps")))


def random_return(record: Record, body: type[MorphEnv]) -> float:
    """Mean return of uniform actions on the first body of a run, over a few episodes of its length."""
    first = designs_of(record.designs.sort_values(["run", "design"])[:1])
    settings = {name: record.settings[name] for name in ("task", "episode_steps") if name in record.settings}
    bodies = body(num_runs=RANDOM_EPISODES, seed=0, **settings)
    design = torch.tensor(first, dtype=torch.float32).expand(RANDOM_EPISODES, -1)
    rows = run_episode(bodies, None, design=design, rng=torch.Generator().manual_seed(0))
    return float(rows["next", "reward"].sum(0).mean())


def model_errors(records: Sequence[Record]) -> Section:
    """How well the ensemble predicted each new episode before it learnt from it."""
    title = "Model error over time"
    figure, (axes,) = new_figure(3.0)
    if len(records) == 1:
        mark_builds(axes, records[0])
    if not plot_over_steps(axes, records, "model_error"):
        return Section(title=title, notes=["No model was learnt."])
    axes.set(xlabel=STEPS, ylabel="squared error over\nvariance of changes", yscale="log")
    low, high = axes.get_ylim()
    axes.yaxis.set(major_locator=LogLocator(subs=(1, 2, 5)), minor_locator=LogLocator(subs=(3, 4, 6, 7, 8, 9)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("{x:g}" if high < 5 * low else NullFormatter())
    axes.axhline(1, color=GREY, linestyle="--", linewidth=0.8)
    explain(figure, records)
    caption = (
        "Squared error of the model's means on each new episode before learning from it, in units of the variance of "
        "one-step changes. Dashed: as good as predicting that nothing changes."
    )
    ends = [f"{r.name}: {m[0]:.3g} to {m[-1]:.3g}" for r in records if (m := _means(r, "model_error")).size]
    return Section(
        title=title,
        figure=figure,
        caption=caption,
        alt="Model error over training steps. " + "; ".join(ends),
        notes=points_in_words(records),
    )


def losses(records: Sequence[Record]) -> Section:
    """Losses of both learners and of the model, and the entropy term."""
    title = "Losses and entropy"
    weighted = [_with_weighted_entropy(record) for record in records]
    figure, grid = new_figure(4.6, 2, 2)
    drawn = False
    alone = len(records) == 1  # faint lines of many runs of several folders would hide everything
    learners = {
        "individual": {"linestyle": "-"},
        "population": {"linestyle": "--"} | ({"color": BLUE} if alone else {}),
    }
    for axes, (name, label) in zip(grid, LOSSES.items()):
        there = False
        for who, style in ({"model": {"linestyle": "-"}} if name == "loss_dynamics" else learners).items():
            there |= plot_over_steps(axes, weighted, f"{who}/{name}", faint=alone, **style)
        axes.set(xlabel=STEPS, ylabel=label)
        axes.locator_params(axis="x", nbins=4)
        axes.set_visible(there)
        drawn |= there
    if not drawn:
        return Section(title=title, notes=["The folder has no metrics.csv, or it has no rows: losses are not known."])
    grey: dict[str, Any] = {"color": BLACK if alone else GREY}
    lines = [Line2D([], [], label=f"{who} learner", **grey | style) for who, style in learners.items()]
    explain(figure, records, mean=False, more=lines)
    caption = "Means over the updates after each episode, of the learners' losses and of the model's."
    caption += " Faint lines: single runs." if alone and records[0].num_runs > 1 else ""
    return Section(
        title=title,
        figure=figure,
        caption=caption,
        alt="Actor loss, critic loss, weighted entropy and model loss over training steps.",
        notes=points_in_words(records),
    )


def times(records: Sequence[Record]) -> Section:
    """Wall-clock of each activity."""
    title = "Time spent"
    spent = [seconds_of_activities(record) for record in records]
    activities = sorted(
        {activity for found in spent for activity in found}, key=lambda name: -max(f.get(name, 0.0) for f in spent)
    )
    if not activities:
        return Section(title=title, notes=["The folder has no metrics.csv, or it has no rows: times are not known."])
    figure, (axes,) = new_figure(0.9 + 0.22 * len(activities) * (1 + len(records)))
    height = 0.8 / len(records)
    for index, found in enumerate(spent):
        places = np.arange(len(activities)) + (index + 0.5) * height - 0.4
        minutes = [found.get(activity, 0.0) / 60 for activity in activities]
        bars = axes.barh(
            places, minutes, height, color=BLUE if len(records) == 1 else style_of(index, len(records))["color"]
        )
        axes.bar_label(bars, [f"{value:.2g}" if value < 1 else number(value, 3) for value in minutes], padding=3)
    axes.set_yticks(range(len(activities)), activities)
    axes.invert_yaxis()
    axes.set(xlabel="wall-clock (min)")
    axes.margins(x=0.12)
    if len(records) > 1:
        explain(figure, records)
    caption = (
        "Wall-clock of each activity, all runs of a folder together. Learners that train side by side overlap; "
        "'between episodes' holds the design search."
    )
    told = [f"{r.name}: " + ", ".join(f"{p} {s / 60:.3g} min" for p, s in f.items()) for r, f in zip(records, spent)]
    return Section(title=title, figure=figure, caption=caption, alt="Wall-clock: " + "; ".join(told))


def seconds_of_activities(record: Record) -> dict[str, float]:
    """Seconds of each activity over all episodes so far, and of what lies between the episodes."""
    rows = record.episodes.drop_duplicates(["design", "episode"], keep="last")  # the same for all runs
    columns = [name for name in rows.columns if name.startswith("seconds/")]
    totals = {name.removeprefix("seconds/"): float(rows[name].sum()) for name in columns}
    if totals:
        totals["between episodes"] = max(0.0, rows["seconds"].iloc[-1] - totals.pop("episode", 0.0))
    return totals


def _with_weighted_entropy(record: Record) -> Record:
    alpha = record.settings.get("alpha", math.nan)
    rows = record.episodes
    columns = [name for name in rows.columns if name.endswith("/entropy")]
    weighted = {f"{name.removesuffix('entropy')}alpha_entropy": alpha * rows[name] for name in columns}
    return replace(record, episodes=rows.assign(**weighted))


def _means(record: Record, column: str) -> np.ndarray:
    return curves(record.episodes, "env_steps", column).mean
