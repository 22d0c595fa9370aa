"""The progress line on a terminal, in a pipe, and when nobody wants it."""

from __future__ import annotations

import io
from itertools import count

import pytest
import torch

from coim import DesignChosen, DesignDone, EpisodeDone
from coim.experiments.run.forecast import Forecast, Work
from coim.experiments.run.progress import Progress, counted

FIELDS = ("design 1/2 first", "episode 2", "return 5.0 (best 7.0)", "imagined 20%", "model error 0.250", "60 updates/s")


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def episode(index: int, number: int, returns: list[float], *, error: float | None = 0.25) -> EpisodeDone:
    return EpisodeDone(
        index=index,
        kind="first",
        episode=number,
        design=torch.ones(len(returns), 2),
        training_return=torch.zeros(len(returns)),
        evaluation_return=torch.tensor(returns),
        env_steps=10,
        imagined=51,
        metrics={} if error is None else {"model_error": torch.full((len(returns),), error)},
        seconds={"episode": 0.5},
    )


def show_two(stream: io.StringIO, **options: bool) -> str:
    progress = Progress(
        num_designs=2, forecast=Forecast(Work(4, 0, 30)), updates=30, imagined_share=0.2, stream=stream, **options
    )
    design = torch.ones(2, 2)
    progress.show(DesignChosen(0, "first", design, None))
    progress.show(episode(0, 0, [6.0, 8.0]))
    progress.show(episode(0, 1, [4.0, 6.0]))
    progress.show(DesignDone(0, "first", design, torch.tensor([6.0, 8.0])))
    progress.end()
    return stream.getvalue()


def test_a_pipe_gets_one_plain_line_per_episode() -> None:
    shown = show_two(io.StringIO())
    assert "\r" not in shown
    assert shown.endswith(" left\n")
    assert len(shown.splitlines()) == 2
    assert all(field in shown.splitlines()[1] for field in FIELDS)


def test_a_terminal_gets_one_line_that_is_written_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    shown = show_two(Terminal())
    assert shown.count("\n") == 1
    first, second = shown.removesuffix("\n").split("\r")[1:]
    assert len(first) == len(second) == 159  # nothing of the first stays beside the second
    assert all(field in second for field in FIELDS)
    assert second.rstrip().endswith(" left")


def test_a_narrow_terminal_still_sees_the_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    last = show_two(Terminal()).removesuffix("\n").split("\r")[-1]
    assert len(last) == 79
    assert last.startswith("1/2 first ep 2 5.0 (best 7.0) im 20% err 0.250 60/s 0:00:0")


@pytest.mark.parametrize("stream", [io.StringIO(), Terminal()])
def test_the_third_episode_says_on_a_line_of_its_own_how_long_the_run_takes(stream: io.StringIO) -> None:
    progress = Progress(num_designs=1, forecast=Forecast(Work(9, 0, 30)), updates=30, stream=stream)
    for number in range(4):
        progress.show(episode(0, number, [1.0]))
    lines = stream.getvalue().replace("\r", "\n").split("\n")
    lines = [line for line in lines if line]
    (at,) = [i for i, line in enumerate(lines) if line.startswith("this run takes about 0 s on this machine")]
    assert at == 2  # after two episodes, before the third


def test_a_governed_run_says_what_share_it_has_earned() -> None:
    stream = io.StringIO()
    progress = Progress(num_designs=1, forecast=Forecast(Work(9, 0, 30)), updates=30, imagined_share=0.2, stream=stream)
    event = episode(0, 0, [1.0, 2.0])
    event.metrics["imagined_share"] = torch.tensor([0.0, 0.1])
    progress.show(event)
    assert "imagined 5%" in stream.getvalue()


@pytest.mark.parametrize("stream", [io.StringIO(), Terminal()])
def test_quiet_is_quiet(stream: io.StringIO) -> None:
    assert show_two(stream, quiet=True) == ""


def test_the_best_return_is_that_of_the_design() -> None:
    stream = io.StringIO()
    progress = Progress(num_designs=2, forecast=Forecast(Work(2, 0, 30)), updates=30, stream=stream)
    for index, value in enumerate((9.0, 3.0)):
        progress.show(DesignChosen(index, "first", torch.ones(1, 2), None))
        progress.show(episode(index, 0, [value], error=None))
    assert "design 2/2 first  episode 1  return 3.0 (best 3.0)  imagined 0%  model error -" in stream.getvalue()


def test_the_best_of_a_fleet_is_the_mean_of_each_runs_best_also_of_one_that_goes_on() -> None:
    def told(best: torch.Tensor | None, returns: list[list[float]]) -> str:
        stream = io.StringIO()
        progress = Progress(num_designs=1, forecast=Forecast(Work(9, 0, 30)), updates=30, best=best, stream=stream)
        for number, values in enumerate(returns):
            progress.show(episode(0, number, values))
        return stream.getvalue()

    assert "return 5.0 (best 7.0)" in told(None, [[8.0, 2.0], [4.0, 6.0]])
    assert "return 5.0 (best 7.0)" in told(torch.tensor([8.0, 2.0]), [[4.0, 6.0]])
    assert "return 4.0 (best 4.0)" in told(torch.tensor([-torch.inf, -torch.inf]), [[4.0, float("nan")]])


def test_a_run_that_has_no_number_is_left_out_of_the_mean() -> None:
    stream = io.StringIO()
    Progress(num_designs=1, forecast=Forecast(Work(2, 0, 30)), updates=30, stream=stream).show(
        episode(0, 0, [float("nan"), 3.0])
    )
    assert "return 3.0 (best 3.0)" in stream.getvalue()
    assert "nan" not in stream.getvalue()


def test_an_interrupted_start_leaves_no_empty_line() -> None:
    stream = Terminal()
    Progress(num_designs=1, forecast=Forecast(Work(1, 0, 30)), updates=1, stream=stream).end()
    assert stream.getvalue() == ""


def test_pieces_of_work_are_counted_every_ten_seconds_and_pass_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = count()
    monkeypatch.setattr("coim.experiments.run.progress.time.monotonic", lambda: 4.0 * next(clock))  # 4 s a piece
    stream = io.StringIO()
    assert list(counted("abcdefgh", 8, "film: pictures", stream=stream)) == list("abcdefgh")
    assert stream.getvalue().splitlines() == [
        "film: pictures: 0 of 8",
        "film: pictures: 3 of 8, about 20 s left",
        "film: pictures: 6 of 8, about 8 s left",
    ]


def test_on_a_terminal_the_count_is_one_line_that_goes_away(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, stream = count(), Terminal()
    monkeypatch.setattr("coim.experiments.run.progress.time.monotonic", lambda: 4.0 * next(clock))
    assert list(counted("ab", 2, "pictures", stream=stream)) == ["a", "b"]
    assert [line.strip() for line in stream.getvalue().split("\r")] == [
        "", "pictures: 0 of 2", "pictures: 1 of 2, about 4 s left", "", "",
    ]  # fmt: skip
