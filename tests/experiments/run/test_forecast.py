"""How long a run will take, told after its third episode and followed until its end."""

from __future__ import annotations

import math

import pytest
import torch

from coim import DesignChosen, EpisodeDone, HopperMorph
from coim.experiments.run.duration import in_words
from coim.experiments.run.forecast import Forecast, Work, work_of
from coim.experiments.run.settings import PRESETS, QUICK, Settings

EPISODE = EpisodeDone(
    index=0,
    kind="first",
    episode=0,
    design=torch.ones(1, 4),
    training_return=torch.zeros(1),
    evaluation_return=torch.zeros(1),
    env_steps=1000,
    imagined=51,
    metrics={},
    seconds={"episode": 13.0, "collect": 2.0, "evaluate": 1.0, "train individual": 9.0, "train population": 9.0},
)
SEARCH = DesignChosen(5, "optimised", torch.ones(1, 4), None)


class Clock:
    """A clock that is set by hand."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def after(forecast: Forecast, clock: Clock, *steps: tuple[EpisodeDone | DesignChosen, float]) -> Forecast:
    for event, seconds in steps:
        clock.now += seconds
        forecast.follow(event)
    return forecast


def test_the_papers_protocol_is_so_many_episodes_and_searches() -> None:
    assert work_of(HopperMorph, PRESETS["paper"]) == Work(
        episodes=5 * 300 + 50 * 100, searches=25, learning=1250 * 3 * 600 + 250 * 3 * 1500
    )
    assert work_of(HopperMorph, QUICK) == Work(episodes=8 * 6, searches=2, learning=1250 * 3 * 192 + 100 * 3 * 600)
    # 6 of 7 designs are chosen, the one that was searched for among them.
    part = work_of(HopperMorph, Settings(num_designs=7, first_episodes=2, episodes=1), episodes=10, designs=6)
    assert (part.episodes, part.searches) == (2, 0)
    assert work_of(HopperMorph, Settings(bodies="random")).searches == 0


def test_the_compiling_episode_counts_for_nothing() -> None:
    clock = Clock()
    forecast = Forecast(Work(10, 0, 1500), clock=clock)
    assert math.isnan(after(forecast, clock, (EPISODE, 60.0)).seconds_left)
    assert after(forecast, clock, (EPISODE, 13.0)).seconds_left == 8 * 13
    assert after(forecast, clock, (EPISODE, 15.0)).seconds_left == 7 * 14


def test_a_search_takes_as_long_as_an_episode_until_one_was_timed() -> None:
    clock = Clock()
    forecast = Forecast(Work(10, 2, 1500), clock=clock)
    assert after(forecast, clock, (EPISODE, 60.0), (EPISODE, 10.0)).seconds_left == 8 * 10 + 2 * 10
    assert after(forecast, clock, (SEARCH, 30.0)).seconds_left == 8 * 10 + 30


def test_the_time_left_follows_a_machine_that_has_become_slower_and_ends_at_nothing() -> None:
    clock = Clock()
    forecast = Forecast(Work(61, 0, 1500), clock=clock)
    after(forecast, clock, *[(EPISODE, 10.0)] * 30, *[(EPISODE, 20.0)] * 20)
    assert forecast.seconds_left == 11 * 20
    assert after(forecast, clock, *[(EPISODE, 20.0)] * 11).seconds_left == 0


def test_the_sentence_is_said_once_and_names_the_quick_preset() -> None:
    clock = Clock()
    forecast = Forecast(Work(6500, 25, 1500), quick=Work(32, 2, 560), clock=clock)
    told = [after(forecast, clock, (EPISODE, seconds)).sentence for seconds in (60.0, 14.0, 14.0, 14.0)]
    assert told[:2] + told[3:] == [None] * 3
    # 88 s + 6497 x 14 s + 25 x 14 s = 25.4 h. Quick: 32 x (4 s + 10 s x 560 / 1500) = 247 s
    assert told[2] == "this run takes about 25 h on this machine, 14 s an episode; --preset quick: about 4 min"


def test_a_run_of_many_short_episodes_is_not_advised_to_take_the_quick_preset() -> None:
    clock = Clock()
    forecast = Forecast(Work(200, 0, 4), quick=Work(32, 2, 560), clock=clock)
    told = after(forecast, clock, *[(EPISODE, 0.1)] * 3).sentence
    # Quick has fewer episodes, with 140 times as many updates after each.
    assert told == "this run takes about 20 s on this machine, 0.1 s an episode"


def test_a_run_that_goes_on_says_what_is_left_and_one_that_is_over_first_says_nothing() -> None:
    clock = Clock()
    forecast = Forecast(Work(3603, 0, 1500), goes_on=True, clock=clock)
    told = after(forecast, clock, (EPISODE, 60.0), (EPISODE, 1.5), (EPISODE, 1.5)).sentence
    assert told == "about 1.5 h left on this machine, 1.5 s an episode"
    short = after(Forecast(Work(3, 0, 1500), clock=clock), clock, *[(EPISODE, 1.0)] * 3)
    assert short.sentence is None


@pytest.mark.parametrize(
    ("seconds", "words"), [(12.3, "12 s"), (600, "10 min"), (9000, "2.5 h"), (91308, "25 h"), (35990, "10.0 h")]
)
def test_times_are_said_as_one_would_say_them(seconds: float, words: str) -> None:
    assert in_words(seconds) == words
