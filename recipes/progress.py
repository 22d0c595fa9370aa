"""What a run shows while it runs: one live line on a terminal, one plain line per episode anywhere else."""

from __future__ import annotations

import shutil
import sys
import time
from typing import TextIO

from coim import DesignChosen, DesignDone, EpisodeDone


class Progress:
    """Follows the events of a run.

    Args:
        num_designs: M.
        total_episodes: of the whole run, for the time left.
        updates: network updates after each episode, for the speed.
        done: episodes that were over before.
        best: return of the present design before, if there is one.
        stream: where to write; None takes standard output.
        quiet: write nothing.
    """

    def __init__(
        self,
        *,
        num_designs: int,
        total_episodes: int,
        updates: int,
        done: int = 0,
        best: float = float("-inf"),
        stream: TextIO | None = None,
        quiet: bool = False,
    ) -> None:
        self._num_designs, self._total, self._updates = num_designs, total_episodes - done, updates
        self._stream, self._quiet = stream or sys.stdout, quiet
        self._live = self._stream.isatty()
        self._episodes, self._best, self._started = 0, best, time.perf_counter()

    def show(self, event: DesignChosen | EpisodeDone | DesignDone) -> None:
        """Write the line of an episode; other events move the state only."""
        if isinstance(event, DesignChosen):
            self._best = float("-inf")
        if self._quiet or not isinstance(event, EpisodeDone):
            return
        self._episodes += 1
        last = float(event.evaluation_return.mean())
        self._best = max(self._best, last)
        line = self._line(event, last)
        if self._live:
            width = shutil.get_terminal_size().columns - 1
            self._stream.write("\r" + line[:width].ljust(width))
        else:
            self._stream.write(line + "\n")
        self._stream.flush()

    def _line(self, event: EpisodeDone, last: float) -> str:
        seconds = event.seconds["episode"]
        error = event.metrics.get("model_error")
        left = (self._total - self._episodes) * (time.perf_counter() - self._started) / self._episodes
        return "  ".join(
            [
                f"design {event.index + 1}/{self._num_designs} {event.kind}",
                f"episode {event.episode + 1}",
                f"return {last:.1f} (best {self._best:.1f})",
                f"imagined {event.imagined}",
                "model error " + ("-" if error is None else f"{float(error.mean()):.3f}"),
                f"{self._updates / seconds:.0f} updates/s",
                f"{_clock(left)} left",
            ]
        )

    def end(self) -> None:
        """Leave the live line behind."""
        if self._live and not self._quiet:
            self._stream.write("\n")


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}"
