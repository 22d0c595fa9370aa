"""A run that was stopped, at whatever moment, goes on as the run that never was; and what is said when it cannot."""

from __future__ import annotations

import json
import resource
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random

import pytest
import torch

from coim import HopperMorph
from recipes import soak
from recipes.checkpoint import Checkpoints
from recipes.experiment import main
from recipes.experiment import run as run_recipe
from recipes.interrupt import Stopped, locked, stopping_at_once
from recipes.replay_file import ReplayFile
from recipes.settings import Settings

TINY = Settings(
    num_designs=4,
    first_episodes=2,
    episodes=2,
    episode_steps=6,
    num_cells=(8,),
    model_cells=(8,),
    individual_updates=2,
    population_updates=2,
    model_updates=2,
    batch_size=10,
    num_particles=4,
    num_iterations=2,
    num_start_states=3,
    threads=1,
    quiet=True,
)
SAVES = 4 + 4 * 2  # each chosen design and each episode


class PowerCut(BaseException):
    """Ends a run where it stands."""


Cut = Callable[..., Path]


def run(folder: Path, **settings: object) -> Path:
    return run_recipe(HopperMorph, "hopper", Settings(**{**vars(TINY), "out": folder, **settings}))


def resume(folder: Path, *options: str) -> None:
    main(HopperMorph, "hopper", ["--resume", str(folder), *options])


@pytest.fixture(autouse=True)
def no_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out what takes longest."""
    monkeypatch.setattr("recipes.experiment.draw_run", lambda folder, body: folder)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was left alone."""
    return run(tmp_path_factory.mktemp("left alone") / "whole")


@pytest.fixture
def cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cut:
    """``cut(after, **settings)``: a run whose process ended after so many checkpoints."""

    def make(after: int, **settings: object) -> Path:
        left, save = after, Checkpoints.save

        def saved_or_cut(checkpoints: Checkpoints, notes: dict) -> None:
            nonlocal left
            if left == 0:
                raise PowerCut
            left -= 1
            save(checkpoints, notes)

        with monkeypatch.context() as patched:
            patched.setattr(Checkpoints, "save", saved_or_cut)
            with pytest.raises(PowerCut):
                run(tmp_path / f"cut {after}", **settings)
        return tmp_path / f"cut {after}"

    return make


@pytest.fixture
def handlers() -> Iterator[None]:
    """Put the signal handlers back that a stopped run leaves to the end of its process."""
    before = {signum: signal.getsignal(signum) for signum in (signal.SIGINT, signal.SIGTERM)}
    yield
    for signum, handler in before.items():
        signal.signal(signum, handler)


@pytest.mark.parametrize("settings", [{}, {"num_runs": 2, "designs": "noisy", "threads": 2}], ids=["one", "fleet"])
def test_a_run_that_was_cut_anywhere_goes_on_as_the_whole_one(
    tmp_path: Path, cut: Cut, settings: dict[str, object]
) -> None:
    left_alone = run(tmp_path / "left alone", **settings)
    for after in (0, 2, 5, SAVES - 1):
        folder = cut(after, **settings)
        resume(folder)
        assert soak.differences(left_alone, folder) == [], after


def test_a_run_killed_at_five_random_moments_is_the_run_that_was_left_alone(tmp_path: Path) -> None:
    settings = Settings(**{**vars(TINY), "num_designs": 7, "num_runs": 2})
    seconds = soak.left_alone(tmp_path / "whole", settings)
    draw = Random(0)
    soak.killed_and_resumed(tmp_path / "killed", settings, *(draw.uniform(0.1, 0.6) * seconds for _ in range(5)))
    assert soak.differences(tmp_path / "whole", tmp_path / "killed") == []


def test_a_finished_run_can_be_resumed_and_given_more_designs(tmp_path: Path) -> None:
    whole, short = run(tmp_path / "whole", num_designs=5), run(tmp_path / "short", num_designs=3)
    resume(short)
    resume(short, "--num-designs", "5")
    assert soak.differences(whole, short) == []
    config = json.loads((short / "config.json").read_text())
    assert config["settings"]["num_designs"] == 5
    assert [entry["changed"] for entry in config["resumed"]] == [{}, {"num_designs": [3, 5]}]


def test_fewer_checkpoints_change_nothing_but_their_number(whole: Path, cut: Cut) -> None:
    folder = cut(4, checkpoint_every=2)
    assert len(list(folder.glob("checkpoint/checkpoint-*"))) == 2
    resume(folder, "--checkpoint-every", "1")
    rows = [soak.rows_without_seconds(path / "evaluations.csv") for path in (whole, folder)]
    assert rows[0] == rows[1]


def test_the_last_two_are_kept_and_the_replay_is_only_appended_to(tmp_path: Path, cut: Cut) -> None:
    early, late = cut(3), cut(SAVES - 1)
    assert [path.name for path in sorted(late.glob("checkpoint/checkpoint-*"))] == [
        f"checkpoint-{number:012d}" for number in (SAVES - 2, SAVES - 1)
    ]
    head, whole = ((folder / "checkpoint" / "replay.bin").read_bytes() for folder in (early, late))
    assert whole.startswith(head)
    assert len(whole) == 7 * 6 * (4 * (11 + 4 + 3 + 11 + 4 + 1) + 3)  # seven episodes of six rows
    sizes = [soak.last_state(folder, "algorithm").stat().st_size for folder in (early, late)]
    assert sizes[0] == pytest.approx(sizes[1], rel=0.05)


DAMAGE = {
    "a flipped bit": ("checkpoint-*/components/*-algorithm/state.pt", lambda data: data[:999] + b"!" + data[1000:]),
    "half a file": ("checkpoint-*/components/*-random/state.pt", lambda data: data[: len(data) // 2]),
    "no manifest": ("checkpoint-*/manifest.json", lambda data: b""),
    "no checksums": ("checkpoint-*/sha256.json", lambda data: b""),
    "lost rows": ("replay.bin", lambda data: data[:-1]),
    "changed rows": ("replay.bin", lambda data: data[:-1] + b"!"),
}


@pytest.mark.parametrize(("pattern", "damage"), DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_checkpoint_is_left_for_the_one_before_it(
    whole: Path, cut: Cut, capsys: pytest.CaptureFixture, pattern: str, damage: Callable[[bytes], bytes]
) -> None:
    folder = cut(6)
    newest = max((folder / "checkpoint").glob(pattern))
    newest.write_bytes(damage(newest.read_bytes()))
    resume(folder)
    said = capsys.readouterr().err
    assert "checkpoint-000000000006 is damaged" in said
    assert "going on from checkpoint-000000000005" in said
    assert soak.differences(whole, folder) == []
    assert (folder / "checkpoint" / "damaged-checkpoint-000000000006").exists()


def test_without_a_whole_checkpoint_nothing_is_touched(cut: Cut) -> None:
    folder = cut(6)
    (folder / "checkpoint" / "replay.bin").write_bytes(b"")
    before = (folder / "evaluations.csv").read_text()
    with pytest.raises(SystemExit, match=r"no checkpoint is whole: .*replay.bin has 0 of its"):
        resume(folder)
    assert (folder / "evaluations.csv").read_text() == before
    assert len(list(folder.glob("checkpoint/checkpoint-*"))) == 2


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--seed", "3", "--lr", "0.1"], r"lr \(0.0003 to 0.1\), seed|seed \(0 to 3\), lr \(0.0003 to 0.1\)"),
        (["--num-cells", "9"], r"num_cells \(\(8,\) to \(9,\)\)"),
        (["--out", "elsewhere"], "out"),
        (["--num-designs", "1"], "num_designs was 4 and can only grow"),
    ],
)
def test_what_would_change_the_past_is_refused_by_name(cut: Cut, options: list[str], sentence: str) -> None:
    folder = cut(6)
    with pytest.raises(SystemExit, match=sentence):
        resume(folder, *options)


def test_what_is_no_run_of_this_environment_is_refused(tmp_path: Path, cut: Cut) -> None:
    with pytest.raises(SystemExit, match="holds no run"):
        resume(tmp_path)
    folder = cut(1)
    config = folder / "config.json"
    config.write_text(config.read_text().replace('"hopper"', '"walker"'))
    with pytest.raises(SystemExit, match=r"holds a run of walker: python -m recipes.walker"):
        resume(folder)


def test_settings_of_another_version_are_named(cut: Cut) -> None:
    folder = cut(1)
    config = folder / "config.json"
    config.write_text(config.read_text().replace('"gamma"', '"discount"'))
    with pytest.raises(SystemExit, match="other settings: discount, gamma"):
        resume(folder)


def test_other_packages_are_told(cut: Cut, capsys: pytest.CaptureFixture) -> None:
    folder = cut(2)
    config = json.loads((folder / "config.json").read_text())
    config["versions"]["mujoco"] = "2.0"
    (folder / "config.json").write_text(json.dumps(config))
    resume(folder)
    assert "mujoco was 2.0 and is" in capsys.readouterr().err


def test_a_second_process_is_refused(cut: Cut) -> None:
    folder = cut(1)
    with locked(folder), pytest.raises(SystemExit, match="is in use by process"):
        resume(folder)


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_run_with_the_line_that_resumes_it(
    whole: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
    handlers: None,
    signum: signal.Signals,
) -> None:
    append = ReplayFile.append

    def append_until_stopped(file: ReplayFile, rows: dict[str, torch.Tensor]) -> None:
        if file.num_rows == 18:
            signal.raise_signal(signum)
        append(file, rows)

    with monkeypatch.context() as patched:
        patched.setattr(ReplayFile, "append", append_until_stopped)
        with pytest.raises(SystemExit) as stop:
            run(tmp_path / "stopped", threads=2)
    assert stop.value.code == 128 + signum
    assert f"to go on: python -m recipes.hopper --resume {tmp_path / 'stopped'}" in capsys.readouterr().err
    resume(tmp_path / "stopped")
    assert soak.differences(whole, tmp_path / "stopped") == []


def stop_and_dawdle(seconds: float) -> None:
    """What a process does that is told to end and takes its time."""
    try:
        with stopping_at_once():
            time.sleep(seconds)
    except Stopped:
        time.sleep(seconds)


def test_a_second_signal_ends_the_process_at_once() -> None:
    process = soak.PLAIN.Process(target=stop_and_dawdle, args=(60,))
    process.start()
    while process.is_alive():
        time.sleep(0.3)
        process.terminate()
    assert process.exitcode in (128 + signal.SIGTERM, -signal.SIGTERM)


def test_a_full_disk_is_one_sentence_and_the_last_checkpoint_is_good(whole: Path, tmp_path: Path) -> None:
    folder = tmp_path / "full"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    size = (whole / "checkpoint" / "replay.bin").stat().st_size
    state = soak.last_state(whole, "algorithm").stat().st_size
    assert state > size
    with pytest.MonkeyPatch.context() as patched:
        save = Checkpoints.save

        def save_to_a_small_disk(checkpoints: Checkpoints, notes: dict) -> None:
            if len(soak.rows_without_seconds(folder / "evaluations.csv")) == 3:
                resource.setrlimit(resource.RLIMIT_FSIZE, (state // 2, hard))
            save(checkpoints, notes)

        patched.setattr(Checkpoints, "save", save_to_a_small_disk)
        try:
            with pytest.raises(
                OSError, match=r"could not be written .*; training stops, the last one, number 4, is good"
            ):
                run(folder)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    resume(folder)
    assert soak.differences(whole, folder) == []
