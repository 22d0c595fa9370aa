"""What a run shows while it runs: one live line on a terminal, one plain line per episode anywhere else."""

from __future__ import annotations

import math
import shutil
import sys
import time
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, TextIO, TypeVar

import torch
from torch import Tensor

from coim.events import DesignChosen, DesignDone, EpisodeDone, running
from coim.experiments.run.duration import in_words

if TYPE_CHECKING:
    from coim.experiments.run.forecast import Forecast  # with it come the searches, which a film does not need

EVERY, EVERY_LIVE = 10.0, 0.2  # s between two lines of a piece of work
PieceT = TypeVar("PieceT")


class Progress:
    """Follows the events of a run.

    Returns and model errors are means over the runs that have one. A live line that is too long for its terminal is
    written in a short form, so that the time left stays in sight on 80 columns. A line of its own says how long the run
    will take, as soon as that is known.

    Args:
        num_designs: M.
        forecast: of the time left.
        updates: network updates after each episode, for the speed.
        imagined_share: of a population batch; a run that is governed says its own in each episode.
        best: return of each run on the present design before, ``[K]``, if there is one.
        stream: where to write; None takes standard output.
        quiet: write nothing.
    """

    def __init__(
        self,
        *,
        num_designs: int,
        forecast: Forecast,
        updates: int,
        imagined_share: float = 0.0,
        best: Tensor | None = None,
        stream: TextIO | None = None,
        quiet: bool = False,
    ) -> None:
        self._num_designs, self._forecast, self._updates = num_designs, forecast, updates
        self._imagined_share = imagined_share
        self._stream, self._quiet = stream or sys.stdout, quiet
        self._live = self._stream.isatty()
        self._episodes, self._best = 0, best

    def show(self, event: DesignChosen | EpisodeDone | DesignDone) -> None:
        """Write the line of an episode, and warn of what went wrong in it; other events move the state only."""
        self._forecast.follow(event)
        if isinstance(event, DesignChosen):
            self._best = None
        if not isinstance(event, EpisodeDone):
            return
        for sentence in mishaps(event):
            self.warn(sentence)
        if self._quiet:
            return
        self._episodes += 1
        last = event.evaluation_return.cpu()
        self._best = last if self._best is None else torch.fmax(self._best, last)
        if forecast := self._forecast.sentence:
            self.end()
            self._stream.write(forecast + "\n")
        long, short = self._lines(event, last, self._best)
        if self._live:
            width = shutil.get_terminal_size().columns - 1
            line = long if len(long) <= width else short
            self._stream.write("\r" + line[:width].ljust(width))
        else:
            self._stream.write(long + "\n")
        self._stream.flush()

    def warn(self, sentence: str) -> None:
        """Write a line of its own to standard error, however quiet the run is."""
        self.end()
        print(f"warning: {sentence}", file=sys.stderr)

    def _lines(self, event: EpisodeDone, last: Tensor, best: Tensor) -> tuple[str, str]:
        """The line in full, and in about 75 characters."""
        design, episode = f"{event.index + 1}/{self._num_designs} {event.kind}", event.episode + 1
        returns = f"{_mean(last):.1f} (best {_mean(best):.1f})"
        error = event.metrics.get("model_error")
        mean_error = "-" if error is None else f"{float(error.nanmean()):.3f}"
        speed = f"{self._updates / event.seconds['episode']:.0f}"
        left = _clock(self._forecast.seconds_left)
        governed = event.metrics.get("imagined_share")
        share = f"{self._imagined_share if governed is None else float(governed.nanmean()):.0%}"
        long = [
            f"design {design}",
            f"episode {episode}",
            f"return {returns}",
            f"imagined {share}",
            f"model error {mean_error}",
            f"{speed} updates/s",
            f"{left} left",
        ]
        short = [design, f"ep {episode}", returns, f"im {share}", f"err {mean_error}", f"{speed}/s", left]
        return "  ".join(long), " ".join(short)

    def end(self) -> None:
        """Leave the live line behind, if there is one."""
        if self._live and not self._quiet and self._episodes:
            self._stream.write("\n")
            self._stream.flush()


def counted(pieces: Iterable[PieceT], total: int, what: str, *, stream: TextIO | None = None) -> Iterator[PieceT]:
    """Pass pieces of work on, and say how many are done: a live line on a terminal, elsewhere one every ten seconds.

    Args:
        pieces: each is worked on before the next is asked for.
        total: how many they are.
        what: how a line begins.
        stream: where to write; None takes standard error.
    """
    stream = stream or sys.stderr
    live = stream.isatty()
    begun = said = time.monotonic()
    line = f"{what}: 0 of {total}"
    for done, piece in enumerate(pieces, 1):
        if line:
            stream.write(f"\r{line.ljust(60)}" if live else f"{line}\n")
            stream.flush()
        yield piece
        now, line = time.monotonic(), ""
        if now - said >= (EVERY_LIVE if live else EVERY):
            line, said = f"{what}: {done} of {total}, about {in_words((now - begun) * (total - done) / done)} left", now
    if live:
        stream.write(f"\r{' ' * 60}\r")
        stream.flush()


def mishaps(event: EpisodeDone) -> list[str]:
    """What went wrong in an episode without ending it, a sentence each."""
    where = f"design {event.index + 1}, episode {event.episode + 1}"
    found = []
    for run in running(event):
        if broken := int(event.metrics.get("broken", {run: 0})[run]):
            found.append(
                f"the simulation of run {run} broke {broken} time(s) in {where}; each time it started again from rest"
            )
        if run in event.diverged:
            left = len(event.design) - len(event.diverged)
            found.append(
                f"run {run} diverged at {where}: its losses or weights are no finite numbers any more. It is frozen "
                f"with the weights of before and gets no more rows; {left} of {len(event.design)} run(s) go on"
            )
    return found


def _mean(returns: Tensor) -> float:
    """Over the runs that have one."""
    return float(returns[returns.isfinite()].mean())


def _clock(seconds: float) -> str:
    if math.isnan(seconds):
        return "-"
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}"
