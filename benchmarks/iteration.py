"""Rows: a whole iteration of Algorithm 1 at the paper's sizes, and its parts."""

from __future__ import annotations

from collections.abc import Callable
from statistics import median

import torch

from benchmarks.effort import Effort
from benchmarks.floors import alone
from benchmarks.measure import Figure, Target, interleaved, over
from benchmarks.parts import update_products
from benchmarks.updates import too_few_cores
from coim import EpisodeDone, HalfCheetahMorph
from coim.envs.native_episode import can_be_native
from coim.experiments.run.build import build
from coim.experiments.run.machine import available_cores
from coim.experiments.run.settings import Settings


def iteration(effort: Effort) -> list[Figure]:
    """Training episode, refresh, updates, evaluation episode of Half-Cheetah."""
    actions: dict[str, Callable[[], object]] = {
        "alone": Iterations(effort, imagine="none"),
        "imagining": Iterations(effort, imagine="known"),
    }
    if available_cores() > 1:
        actions["side by side"] = Iterations(effort, imagine="known", side_by_side=True)
    updates = effort.individual_updates + effort.population_updates
    floor = alone(update_products(effort), times=updates)
    times = interleaved({"floor": floor, **actions}, effort.long_repeats)
    parts = {name: run.parts() for name, run in actions.items() if isinstance(run, Iterations)}
    found = [
        Figure(
            row="iteration without imagination, 1 thread",
            against=f"floor of its {updates:,} updates",
            ratios=over(times["alone"], times["floor"]),
            amounts=tuple(times["alone"]),
            unit="s",
            target=Target(1.5),
            note=f"floor {median(times['floor']):.2f} s; {_as_text(parts['alone'])}",
            parts=parts["alone"],
        ),
        Figure(
            row="iteration with imagination, 1 thread",
            against="the one without",
            ratios=over(times["imagining"], times["alone"]),
            amounts=tuple(times["imagining"]),
            unit="s",
            note=_as_text(parts["imagining"]),
            parts=parts["imagining"],
        ),
    ]
    row, against = "iteration with imagination, side by side on 2 cores", "one after the other on 1 thread"
    if "side by side" not in times:
        return [*found, Figure(row=row, against=against, note=too_few_cores(2))]
    beside = Figure(
        row=row,
        against=against,
        ratios=over(times["side by side"], times["imagining"]),
        amounts=tuple(times["side by side"]),
        unit="s",
        target=Target(0.6),
        note=_as_text(parts["side by side"]),
        parts=parts["side by side"],
    )
    return [*found, beside]


class Iterations:
    """One run of Algorithm 1, an iteration at a time; the first call also builds the first body."""

    def __init__(
        self,
        effort: Effort,
        *,
        imagine: str,
        side_by_side: bool = False,
        num_runs: int = 1,
        device: torch.device | str = "cpu",
        compile: bool = True,
        threads: int | None = None,
    ) -> None:
        settings = Settings(
            imagine=imagine,  # type: ignore[arg-type]
            num_designs=1,
            first_episodes=effort.long_repeats + 2,
            episode_steps=effort.episode_steps,
            individual_updates=effort.individual_updates,
            population_updates=effort.population_updates,
            model_updates=effort.model_updates,
            batch_size=effort.batch_size,
            num_cells=effort.num_cells,
            model_cells=effort.model_cells,
            num_runs=num_runs,
            device=str(device),
            compile=compile,
            native_episodes=can_be_native(),
        )
        threads = threads or (2 if side_by_side else 1)
        self._events = iter(build(HalfCheetahMorph, settings, threads=threads, side_by_side=side_by_side))
        self._done: list[EpisodeDone] = []

    def __call__(self) -> None:
        """Go on to the end of the next iteration."""
        self._done.append(next(event for event in self._events if isinstance(event, EpisodeDone)))

    def parts(self) -> dict[str, float]:
        """Median seconds of each part, the first iteration left out."""
        measured = [event.seconds for event in self._done[1:]]
        return {part: median(seconds[part] for seconds in measured) for part in measured[0]}


def _as_text(parts: dict[str, float]) -> str:
    return ", ".join(f"{part.removeprefix('train ')} {seconds:.2f}" for part, seconds in parts.items())
