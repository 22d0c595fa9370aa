"""A run that was cut short, at whatever moment, goes on as the run that never was; and what is said when it cannot."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest
from interrupted_runs import SAVES, PowerCut, cut
from tiny_runs import TINY, resume, run

from benchmarks import soak
from coim.experiments.run.checkpoint import Checkpoints
from coim.experiments.run.settings import Settings
from coim.run_folder import EVALUATIONS


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was left alone."""
    return run(tmp_path_factory.mktemp("left alone") / "whole")


@pytest.mark.parametrize(
    ("settings", "stops"),
    [({}, [0, 5]), ({"num_runs": 2, "imagine": "noisy", "threads": 2}, [2, SAVES - 1])],
    ids=["one", "fleet"],
)
def test_a_run_that_was_cut_anywhere_goes_on_as_the_whole_one(
    tmp_path: Path, settings: dict[str, object], stops: list[int]
) -> None:
    left_alone = run(tmp_path / "left alone", **settings)
    for after in stops:
        folder = cut(tmp_path / str(after), after, **settings)
        resume(folder)
        assert soak.differences(left_alone, folder) == [], after


@pytest.mark.parametrize(("step", "good"), [("parts", 5), ("sync", 5), ("os.replace", 5), ("CheckpointRotation", 6)])
def test_a_checkpoint_that_was_cut_in_its_middle_harms_nothing(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, good: int
) -> None:
    """The power goes at one step of writing the sixth checkpoint; a later one finds the fifth, or the sixth."""
    folder, save, loaded = tmp_path / "cut", Checkpoints.save, Checkpoints._read
    read: list[str] = []

    def power_cut(*args: object, **kwargs: object) -> None:
        raise PowerCut

    def save_until_cut(checkpoints: Checkpoints, notes: dict) -> None:
        if checkpoints._step == 5:
            patched.setattr(f"coim.experiments.run.checkpoint.{step}", power_cut)
        save(checkpoints, notes)

    def noted(checkpoints: Checkpoints, path: Path) -> dict:
        read.append(path.name)
        return loaded(checkpoints, path)

    with monkeypatch.context() as patched:
        patched.setattr(Checkpoints, "save", save_until_cut)
        with pytest.raises(PowerCut):
            run(folder)
    monkeypatch.setattr(Checkpoints, "_read", noted)
    resume(folder)
    assert read == [f"checkpoint-{good:012d}"]
    assert soak.differences(whole, folder) == []


def test_a_run_killed_at_five_random_moments_is_the_run_that_was_left_alone(tmp_path: Path) -> None:
    settings = Settings(**{**vars(TINY), "num_designs": 7, "num_runs": 2})
    seconds = soak.left_alone(tmp_path / "whole", settings)
    draw = Random(0)
    soak.killed_and_resumed(tmp_path / "killed", settings, *(draw.uniform(0.1, 0.6) * seconds for _ in range(5)))
    assert soak.differences(tmp_path / "whole", tmp_path / "killed") == []


def test_a_compiled_run_that_was_killed_is_the_run_that_was_left_alone(tmp_path: Path) -> None:
    settings, killed = soak.KINDS["compiled"], tmp_path / "killed"
    soak.left_alone(tmp_path / "whole", settings)
    process = soak.start(killed, settings)
    while not list(killed.glob("checkpoint/checkpoint-*4")) and process.is_alive():
        time.sleep(0.01)
    process.kill()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    soak.finish(soak.start(killed, settings))
    assert soak.differences(tmp_path / "whole", killed) == []


def test_a_finished_run_can_be_resumed_and_given_more_designs(tmp_path: Path) -> None:
    whole, short = run(tmp_path / "whole", num_designs=5), run(tmp_path / "short", num_designs=3)
    resume(short)
    resume(short, "--num-designs", "5")
    assert soak.differences(whole, short) == []
    config = json.loads((short / "config.json").read_text())
    assert config["settings"]["num_designs"] == 5
    assert [entry["changed"] for entry in config["resumed"]] == [{}, {"num_designs": [3, 5]}]
    for entry in config["resumed"]:
        assert (entry["revision"], entry["versions"]) == (config["revision"], config["versions"])


def test_fewer_checkpoints_change_nothing_but_their_number(whole: Path, tmp_path: Path) -> None:
    folder = cut(tmp_path / "cut", 4, checkpoint_every=2)
    assert len(list(folder.glob("checkpoint/checkpoint-*"))) == 2
    resume(folder, "--checkpoint-every", "1")
    rows = [soak.rows_without_seconds(path, EVALUATIONS) for path in (whole, folder)]
    assert rows[0] == rows[1]


def test_the_last_two_are_kept_and_the_replay_is_only_appended_to(tmp_path: Path) -> None:
    early, late = cut(tmp_path / "early", 3), cut(tmp_path / "late", SAVES - 1)
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
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture, pattern: str, damage: Callable[[bytes], bytes]
) -> None:
    folder = cut(tmp_path / "cut", 6)
    newest = max((folder / "checkpoint").glob(pattern))
    newest.write_bytes(damage(newest.read_bytes()))
    resume(folder)
    said = capsys.readouterr().err
    assert "checkpoint-000000000006 is damaged" in said
    assert "going on from checkpoint-000000000005" in said
    assert soak.differences(whole, folder) == []
    assert (folder / "checkpoint" / "damaged-checkpoint-000000000006").exists()


def test_damaged_checkpoints_do_not_pile_up_and_are_not_in_the_way(tmp_path: Path) -> None:
    folder = cut(tmp_path / "cut", 6) / "checkpoint"
    for number in ("000000000004", "000000000006"):  # of earlier times; the sixth has been written anew since
        (folder / f"damaged-checkpoint-{number}").mkdir()
        (folder / f"damaged-checkpoint-{number}" / "manifest.json").write_bytes(b"")
    (folder / "checkpoint-000000000006" / "manifest.json").write_bytes(b"")
    resume(tmp_path / "cut")
    assert [path.name for path in folder.glob("damaged-*")] == ["damaged-checkpoint-000000000006"]


def test_without_a_whole_checkpoint_nothing_is_touched(tmp_path: Path) -> None:
    folder = cut(tmp_path / "cut", 6)
    (folder / "checkpoint" / "replay.bin").write_bytes(b"")
    before = (folder / "evaluations.csv").read_text()
    with pytest.raises(SystemExit, match=r"no checkpoint is whole: .*replay.bin has 0 of its"):
        resume(folder)
    assert (folder / "evaluations.csv").read_text() == before
    assert len(list(folder.glob("checkpoint/checkpoint-*"))) == 2
