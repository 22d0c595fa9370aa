"""How long a run will take on this machine, from the episodes that it has made."""

from __future__ import annotations

import math
import statistics
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from coim.envs import MorphEnv
from coim.events import DesignChosen, DesignDone, EpisodeDone
from coim.experiments.run.build import episodes_of_designs, first_designs
from coim.experiments.run.duration import in_words
from coim.experiments.run.settings import Settings

NEEDED = 2  # timed episodes before a sentence is said; the one before them compiles
RECENT = 20  # episodes that the time left goes by: other work on a machine comes and goes


@dataclass(frozen=True)
class Work:
    """What a run has to do, or what is left of it.

    Attributes:
        episodes: of training, each with its updates and its evaluation.
        searches: designs that are to be found by Eq. 5.
        learning: updates after an episode, each times the hidden units of its networks. An update takes longer by a
            power of the units between 1 and 2, so that smaller networks are at least as quick as this says.
    """

    episodes: int
    searches: int
    learning: int


def work_of(body: type[MorphEnv], settings: Settings, *, episodes: int = 0, designs: int = 0) -> Work:
    """The work of a run.

    Args:
        body: the environment.
        settings: of the run.
        episodes: that are over.
        designs: that are chosen.

    Example:
        >>> from coim import HopperMorph
        >>> work_of(HopperMorph, Settings())  # 5 x 300 + 50 x 100 episodes; every other later design is a random one
        Work(episodes=6500, searches=25, learning=3375000)
    """
    searched = range(len(first_designs(body, settings)), settings.num_designs, 2) if settings.bodies == "search" else ()
    return Work(
        episodes=sum(episodes_of_designs(body, settings)) - episodes,
        searches=sum(index >= designs for index in searched),
        learning=(settings.individual_updates + settings.population_updates)
        * (1 + settings.num_critics)
        * sum(settings.num_cells)
        + settings.model_updates * settings.num_members * sum(settings.model_cells),
    )


class Forecast:
    """Follows the events of a run and tells how long what is left will take.

    Every episode costs the same whatever its design: there are as many updates after each, and as many imagined rows.
    Only the first one of a process is longer, since it compiles, and counts for nothing here. A search of Eq. 5 takes
    what the last one took, and as long as an episode until there was one.

    Args:
        left: work that is left.
        goes_on: whether other processes did the beginning of the run.
        quick: the work of ``--preset quick``, if that is worth a word; it is told where it takes less.
        clock: seconds.
    """

    def __init__(
        self,
        left: Work,
        *,
        goes_on: bool = False,
        quick: Work | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._left, self._goes_on, self._quick, self._clock = left, goes_on, quick, clock
        self._started = self._last = clock()
        self._episodes, self._searches = 0, 0  # that this process made
        self._recent: deque[float] = deque(maxlen=RECENT)
        self._learning: deque[float] = deque(maxlen=RECENT)
        self._search = math.nan

    def follow(self, event: DesignChosen | EpisodeDone | DesignDone) -> None:
        """Note how long it was since the event before."""
        now = self._clock()
        took, self._last = now - self._last, now
        if isinstance(event, EpisodeDone):
            self._episodes += 1
            if self._episodes > 1:
                self._recent.append(took)
                parts = event.seconds
                self._learning.append(parts["episode"] - parts.get("collect", 0.0) - parts.get("evaluate", 0.0))
        elif isinstance(event, DesignChosen) and event.kind == "optimised":
            self._searches += 1
            self._search = took

    @property
    def seconds_left(self) -> float:
        """Until the end; NaN while no episode was timed."""
        episodes, searches = self._left.episodes - self._episodes, self._left.searches - self._searches
        if episodes <= 0:
            return 0.0
        if not self._recent:
            return math.nan
        episode = statistics.fmean(self._recent)
        return episodes * episode + searches * (episode if math.isnan(self._search) else self._search)

    @property
    def sentence(self) -> str | None:
        """How long the run will take, when that is first known; None before, afterwards and at the end."""
        if self._episodes != NEEDED + 1 or self._left.episodes <= self._episodes:
            return None
        left, episode = self.seconds_left, statistics.fmean(self._recent)
        each = f"{episode:.2g} s an episode" if episode < 10 else f"{episode:.0f} s an episode"
        if self._goes_on:
            return f"about {in_words(left)} left on this machine, {each}"
        whole = self._clock() - self._started + left
        told = f"this run takes about {in_words(whole)} on this machine, {each}"
        if self._quick is not None and (quick := self._quick_seconds(self._quick, episode)) < whole:
            told += f"; --preset quick: about {in_words(quick)}"
        return told

    def _quick_seconds(self, quick: Work, episode: float) -> float:
        """The same episodes, with other numbers of them and other learning after each; its searches are short."""
        learning = statistics.fmean(self._learning)
        return quick.episodes * (episode - learning + learning * quick.learning / max(1, self._left.learning))
