"""What ends a run before its time, and what is refused when it shall go on."""

from __future__ import annotations

import json
import resource
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.synchronize import Event
from pathlib import Path
from threading import Thread

import pytest
import torch
from interrupted_runs import cut
from tiny_runs import resume, run

from benchmarks import soak
from coim import HopperMorph, load_run
from coim.experiments.commands import model_error
from coim.experiments.frames import designs_of
from coim.experiments.run.checkpoint import Checkpoints, SharedRandom
from coim.experiments.run.interrupt import Stopped, end_soon, locked, stopping_at_once
from coim.experiments.run.records import read_record
from coim.experiments.run.replay_file import ReplayFile
from coim.experiments.run.resume import LATER
from coim.experiments.train import main
from coim.products import Choice
from coim.run_folder import EVALUATIONS, read_config


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was left alone."""
    return run(tmp_path_factory.mktemp("left alone") / "whole")


@pytest.fixture
def handlers() -> Iterator[None]:
    """Put the signal handlers back that a stopped run leaves to the end of its process."""
    before = {signum: signal.getsignal(signum) for signum in (signal.SIGINT, signal.SIGTERM)}
    yield
    for signum, handler in before.items():
        signal.signal(signum, handler)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--seed", "3", "--lr", "0.1"], r"lr \(0.0003 to 0.1\), seed|seed \(0 to 3\), lr \(0.0003 to 0.1\)"),
        (["--num-cells", "9"], r"num_cells \(\(8,\) to \(9,\)\)"),
        (["--out", "elsewhere"], "out"),
        (["--num-designs", "1"], "num_designs was 4 and can only grow"),
    ],
)
def test_what_would_change_the_past_is_refused_by_name(tmp_path: Path, options: list[str], sentence: str) -> None:
    folder = cut(tmp_path / "cut", 6)
    with pytest.raises(SystemExit, match=sentence):
        resume(folder, *options)


def test_a_table_that_cannot_be_read_at_the_end_is_refused_at_the_start(tmp_path: Path) -> None:
    folder = cut(tmp_path / "cut", 6)
    table = folder / "designs.csv"
    table.write_text(table.read_text().replace(",first,1,", ",first,abc,"))
    with pytest.raises(SystemExit, match=r"designs\.csv, line 2: found 'abc' in column xi_torso, expected a number"):
        resume(folder, page=True)
    assert not (folder / "report.html").exists()
    assert len((folder / "evaluations.csv").read_text().splitlines()) == 1 + 4


def test_what_is_no_run_of_this_environment_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="holds no run"):
        resume(tmp_path)
    folder = cut(tmp_path / "cut", 1)
    config = folder / "config.json"
    config.write_text(config.read_text().replace('"hopper"', '"walker"'))
    with pytest.raises(SystemExit, match=r"holds a run of walker: coim resume "):
        resume(folder)


def test_settings_of_another_version_are_named(tmp_path: Path) -> None:
    folder = cut(tmp_path / "cut", 1)
    config = folder / "config.json"
    config.write_text(config.read_text().replace('"gamma"', '"discount"'))
    with pytest.raises(SystemExit, match="other settings: discount, gamma"):
        resume(folder)


def test_a_run_whose_files_count_the_entries_of_a_design_goes_on_and_is_read(whole: Path, tmp_path: Path) -> None:
    folder = cut(tmp_path / "older", 9)
    for name in ("evaluations.csv", "designs.csv"):
        text = (folder / name).read_text()
        for i, entry in enumerate(("torso", "thigh", "shank", "foot")):
            text = text.replace(f"xi_{entry}", f"xi_{i + 1}", 1)
        (folder / name).write_text(text)
    resume(folder)
    assert (folder / "designs.csv").read_text().splitlines()[1:] == (whole / "designs.csv").read_text().splitlines()[1:]
    for older, newer in zip(load_run(folder).designs, load_run(whole).designs, strict=True):
        assert older.design.tolist() == newer.design.tolist()
    one, other = (designs_of(read_record(run, "").designs) for run in (folder, whole))
    assert one.tolist() == other.tolist()


def test_a_run_that_was_begun_before_a_setting_was_there_goes_on(tmp_path: Path, whole: Path) -> None:
    folder = cut(tmp_path / "cut", 6)
    config = json.loads((folder / "config.json").read_text())
    begun_by = config.pop("products")
    for name in LATER:
        del config["settings"][name]
    config["settings"]["designs"] = config["settings"].pop("imagine")
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("coim.experiments.run.resume.FORMERLY", Choice(**begun_by))  # whatever this machine has
        resume(folder)
    assert soak.differences(whole, folder) == []


def test_settings_of_earlier_runs_are_read_under_their_names_of_today() -> None:
    cells = Path(__file__).parents[3] / "docs/results/preview/cells"
    config = json.loads((cells / "hopper-forward-noisy-0" / "config.json").read_text())
    assert "imagine" not in config["settings"]
    assert read_config(cells / "hopper-forward-noisy-0")["settings"]["imagine"] == "noisy"


def test_other_packages_are_told(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder = cut(tmp_path / "cut", 2)
    config = json.loads((folder / "config.json").read_text())
    config["versions"]["mujoco"] = "2.0"
    (folder / "config.json").write_text(json.dumps(config))
    resume(folder)
    assert "mujoco was 2.0 and is" in capsys.readouterr().err


def test_a_run_goes_on_where_there_is_no_gpu_and_no_compiler(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    folder = cut(tmp_path / "cut", 6)
    config = json.loads((folder / "config.json").read_text())
    config["settings"] |= {"device": "cuda", "compile": True, "native_episodes": True}
    (folder / "config.json").write_text(json.dumps(config))
    if not torch.cuda.is_available():
        with pytest.raises(SystemExit, match=r"device 'cuda' cannot be used here .*; try --device cpu"):
            resume(folder)
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(SystemExit, match=r"no C\+\+ compiler .* or --no-compile --no-native-episodes"):
        resume(folder, "--device", "cpu")
    capsys.readouterr()
    with pytest.raises(SystemExit, match=r"no C\+\+ compiler .* or --no-native-episodes"):
        resume(folder, "--device", "cpu", "--no-compile")
    capsys.readouterr()
    resume(folder, "--device", "cpu", "--no-compile", "--no-native-episodes")
    said = capsys.readouterr().err.splitlines()
    assert [line for line in said if "products" not in line] == [
        "warning: device was cuda and is cpu; the numbers may differ from here",
        "warning: compile was True and is False; the numbers may differ from here",
        "warning: native_episodes was True and is False; the numbers may differ from here",
    ]
    assert soak.differences(whole, folder) == []  # it was cpu and not compiled in truth
    config = json.loads((folder / "config.json").read_text())
    assert config["settings"]["device"] == "cpu"
    assert config["resumed"][-1]["changed"] == {
        "device": ["cuda", "cpu"],
        "compile": [True, False],
        "native_episodes": [True, False],
    }


def test_generators_of_a_gpu_that_is_not_here_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    shared = SharedRandom()
    state = shared.state_dict()
    expected = torch.rand(3)
    shared.load_state_dict(state | {"torch_xpu": [torch.zeros(16, dtype=torch.uint8)]})
    assert torch.equal(torch.rand(3), expected)
    # Of two GPUs one is left.
    restored: list[list[str]] = []
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.is_initialized", lambda: True)
    monkeypatch.setattr("torch.cuda.get_rng_state_all", lambda: [torch.zeros(1)])
    monkeypatch.setattr("torch.cuda.set_rng_state_all", restored.append)
    shared.load_state_dict(state | {"torch_cuda": [torch.ones(1), torch.zeros(1)]})
    assert restored == [[torch.ones(1)]]


def test_a_second_process_is_refused(tmp_path: Path) -> None:
    folder = cut(tmp_path / "cut", 1)
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
            run(tmp_path / "a stopped run", threads=2)
    assert stop.value.code == 128 + signum
    assert f"to go on: coim resume '{tmp_path / 'a stopped run'}'" in capsys.readouterr().err
    resume(tmp_path / "a stopped run")
    assert soak.differences(whole, tmp_path / "a stopped run") == []


def dawdle(working: Event, stopping: Event) -> None:
    """What a process does that is told to end and takes its time."""
    try:
        with stopping_at_once():
            working.set()
            time.sleep(60)
    except Stopped:
        stopping.set()
        time.sleep(60)


def test_a_second_signal_ends_the_process_at_once() -> None:
    working, stopping = soak.PLAIN.Event(), soak.PLAIN.Event()
    process = soak.PLAIN.Process(target=dawdle, args=(working, stopping))
    process.start()
    for reached in (working, stopping):
        assert reached.wait(60)
        process.terminate()
    process.join(30)
    assert process.exitcode == 128 + signal.SIGTERM


def linger() -> None:
    """What a process does that was told to end while another thread of it compiles."""
    Thread(target=time.sleep, args=(60,)).start()
    end_soon(signal.SIGTERM)


def test_a_thread_that_is_not_over_does_not_keep_a_stopped_process() -> None:
    process = soak.PLAIN.Process(target=linger)
    process.start()
    process.join(40)
    assert process.exitcode == 128 + signal.SIGTERM


@pytest.mark.parametrize(
    ("command_line", "words"), [(lambda: main(HopperMorph, "hopper"), []), (model_error.main, ["hopper"])]
)
def test_a_command_line_that_was_stopped_ends_soon_and_says_what_to_do(
    command_line: Callable[[], None],
    words: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
    handlers: None,
) -> None:
    told: list[int] = []
    monkeypatch.setattr("coim.experiments.run.interrupt.end_soon", told.append)
    monkeypatch.setattr("coim.experiments.train.follow", lambda *args: signal.raise_signal(signal.SIGTERM))
    monkeypatch.setattr("sys.argv", ["program", *words, "--preset", "quick", "--out", str(tmp_path / "run"), "--quiet"])
    with pytest.raises(SystemExit) as stop:
        command_line()
    assert stop.value.code == 128 + signal.SIGTERM
    assert told == [signal.SIGTERM]
    # There is no run yet: one could not go on with it.
    assert capsys.readouterr().err == "\nstopped by SIGTERM; nothing was written yet, start it again\n"


def test_a_full_disk_is_one_sentence_and_the_last_checkpoint_is_good(whole: Path, tmp_path: Path) -> None:
    folder = tmp_path / "full"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    size = (whole / "checkpoint" / "replay.bin").stat().st_size
    state = soak.last_state(whole, "algorithm").stat().st_size
    assert state > size
    with pytest.MonkeyPatch.context() as patched:
        save = Checkpoints.save

        def save_to_a_small_disk(checkpoints: Checkpoints, notes: dict) -> None:
            if len(soak.rows_without_seconds(folder, EVALUATIONS)) == 3:
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


@contextmanager
def spoiling(error: BaseException) -> Iterator[None]:
    """Raise something else in the place of what is raised within, as compiled code and Ray do."""
    try:
        yield
    except Stopped:
        raise error from None


@pytest.mark.usefixtures("handlers")
@pytest.mark.parametrize("error", [RuntimeError("Stopped: ..."), KeyboardInterrupt()])
def test_a_stop_of_which_something_made_its_own_error_is_still_a_stop(error: BaseException) -> None:
    with pytest.raises(Stopped) as stop, stopping_at_once(), spoiling(error):
        signal.raise_signal(signal.SIGTERM)
    assert stop.value.signum == signal.SIGTERM


def test_errors_of_who_was_not_told_to_stop_stay_what_they_are() -> None:
    with pytest.raises(RuntimeError, match="own"), stopping_at_once():
        raise RuntimeError("own")
