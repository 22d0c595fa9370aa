"""Disks that are full, and file systems that have no locks or do not sync folders."""

from __future__ import annotations

import errno
import io
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tiny_runs import resume, run, run_by_options

from benchmarks import soak
from coim import SACLearner, load_run
from coim.experiments.commands import report
from coim.experiments.report.run_report import write_report
from coim.experiments.run import atomic_write as writing
from coim.experiments.run.atomic_write import sync, warn_once, write_whole, written_aside
from coim.experiments.run.best_policies import BestPolicies
from coim.experiments.run.checkpoint import Checkpoints
from coim.experiments.run.interrupt import locked
from coim.experiments.run.replay_file import ReplayFile
from coim.experiments.run.results import Results
from coim.run_folder import read_config

FSYNC = os.fsync


@pytest.fixture(autouse=True)
def nothing_was_said_yet() -> Iterator[None]:
    warn_once.cache_clear()
    yield
    warn_once.cache_clear()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on a usual disk."""
    return run(tmp_path_factory.mktemp("usual") / "whole")


def failing_with(number: int) -> Callable[..., None]:
    def fail(*args: object) -> None:
        raise OSError(number, os.strerror(number))

    return fail


def fsync_of_files_only(number: int) -> Callable[[int], None]:
    def fsync(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(number, os.strerror(number))
        FSYNC(descriptor)

    return fsync


def test_a_system_without_locks_at_all_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr("coim.experiments.run.interrupt.fcntl", None)
    with locked(tmp_path):
        pass
    assert f"warning: {tmp_path} cannot be locked" in capsys.readouterr().err


@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP])
@pytest.mark.parametrize("no_lock", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_and_synced_folders_is_told_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, number: int, no_lock: int
) -> None:
    monkeypatch.setattr("fcntl.flock", failing_with(no_lock))
    monkeypatch.setattr("os.fsync", fsync_of_files_only(number))
    with locked(tmp_path):
        for i in range(3):
            write_whole(tmp_path / "file", str(i))
    assert (tmp_path / "file").read_text() == "2"
    first, second = capsys.readouterr().err.splitlines()
    assert f"warning: {tmp_path} cannot be locked, its file system has no locks" in first
    assert f"does not write folders to the disk when it is asked to ({os.strerror(number)})" in second


def test_a_run_goes_on_there_and_is_the_same_run(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr("fcntl.flock", failing_with(errno.ENOLCK))
    monkeypatch.setattr("os.fsync", fsync_of_files_only(errno.EINVAL))
    folder = run(tmp_path / "run", page=True)
    assert len(capsys.readouterr().err.splitlines()) == 2
    assert soak.differences(whole, folder) == []
    assert (folder / "report.html").is_file()


def test_every_other_error_of_locks_and_of_syncing_stays_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        patched.setattr("fcntl.flock", failing_with(errno.EIO))
        with pytest.raises(OSError, match=os.strerror(errno.EIO)), locked(tmp_path):
            raise AssertionError
    with monkeypatch.context() as patched:
        patched.setattr("os.fsync", fsync_of_files_only(errno.EIO))
        with pytest.raises(OSError, match=os.strerror(errno.EIO)):
            sync(tmp_path)
    # That a file's contents are not on the disk is never only a warning.
    (tmp_path / "file").touch()
    monkeypatch.setattr("os.fsync", failing_with(errno.EINVAL))
    with pytest.raises(OSError, match=os.strerror(errno.EINVAL)):
        sync(tmp_path / "file")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_file_that_finds_no_room_stays_as_it_was_and_nothing_lies_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    path = tmp_path / "file"
    write_whole(path, "old")
    monkeypatch.setattr("os.fsync", failing_with(number))
    with pytest.raises(OSError, match=f"^disk full: {path} could not be written; make room on the disk of {tmp_path}$"):
        write_whole(path, "new")
    assert [found.name for found in tmp_path.iterdir()] == ["file"]
    assert path.read_text() == "old"


def test_a_library_is_not_asked_to_write_into_a_folder_that_is_read_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path) -> None:
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    monkeypatch.setattr("pathlib.Path.touch", refuse)
    with pytest.raises(OSError, match="Read-only file system"), written_aside(tmp_path / "film.mp4"):
        pytest.fail("an encoder would say so in three lines of its own")


@pytest.mark.parametrize("error", [RuntimeError("inline_container.cc:664"), OSError("the writer has failed")])
def test_a_librarys_own_error_is_told_as_a_full_disk_only_on_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def write() -> None:
        with written_aside(tmp_path / "file") as aside:
            aside.touch()
            raise error

    with pytest.raises(type(error), match=str(error)):
        write()
    monkeypatch.setattr(writing, "has_no_room", lambda folder: folder == tmp_path)
    with pytest.raises(OSError, match=r"^disk full: "):
        write()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("owner", "method"),
    [(ReplayFile, "append"), (Checkpoints, "save"), (Results, "write"), (BestPolicies, "follow")],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_a_run_that_fills_its_disk_says_so_and_how_it_goes_on(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, owner: type, method: str
) -> None:
    folder, write, calls = tmp_path / "run", getattr(owner, method), 0

    def write_to_a_full_disk(*args: object) -> None:
        nonlocal calls
        calls += 1
        with monkeypatch.context() as patched:
            if calls >= 5:
                patched.setattr("os.fsync", failing_with(errno.ENOSPC))
            write(*args)

    with monkeypatch.context() as patched:
        patched.setattr(owner, method, write_to_a_full_disk)
        with pytest.raises(OSError, match="disk full: ") as stop:
            run(folder)
    said = str(stop.value)
    assert f"make room on the disk of {folder}" in said
    assert f"to go on: coim resume {folder}" in said
    assert "\n" not in said
    resume(folder)
    assert soak.differences(whole, folder) == []


def test_a_compiler_that_fills_the_disk_says_so_and_how_the_run_goes_on(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def compile_on_a_full_disk(*args: object) -> None:
        raise RuntimeError("C++ compile error\n\nfatal error: cannot write PCH file: No space left on device")

    folder, cache = tmp_path / "run", tmp_path / "cache"
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(cache))
    with monkeypatch.context() as patched:
        patched.setattr(SACLearner, "update", compile_on_a_full_disk)
        with pytest.raises(OSError, match=rf"^disk full: nothing can be compiled in {cache} .* coim resume {folder}$"):
            run(folder)
    resume(folder)
    assert soak.differences(whole, folder) == []


def test_a_disk_that_is_full_when_the_page_is_written_does_not_cost_the_run(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write_on_a_full_disk(*args: Any, **kwargs: Any) -> Path:
        with monkeypatch.context() as patched:
            patched.setattr("os.fsync", failing_with(errno.ENOSPC))
            return write_report(*args, **kwargs)

    folder = tmp_path / "run"
    with monkeypatch.context() as patched:
        patched.setattr("coim.experiments.train.write_report", write_on_a_full_disk)
        with pytest.raises(OSError, match=rf"disk full: .*coim report {folder}"):
            run(folder, page=True)
    assert soak.differences(whole, folder) == []


def test_a_folder_whose_name_is_not_utf_8_has_a_run_a_page_and_a_comparison(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = [tmp_path / os.fsdecode(name) for name in (b"M\xe4nner", b"Frau")]
    try:
        folders[0].mkdir()
    except OSError:
        pytest.skip("this file system has no such names")
    printed = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(printed, encoding="utf-8", errors="strict", write_through=True))
    for folder in folders:
        run_by_options(folder, "--num-designs", "1", page=True)
    report.main([str(folder) for folder in folders] + ["--out", str(tmp_path / "both.html")])
    for page in (folders[0] / "report.html", tmp_path / "both.html"):
        assert "M\ufffdnner" in page.read_text(encoding="utf-8")
    assert rb"M\udce4nner/report.html" in printed.getvalue()
    assert load_run(folders[0]).designs[0].number == 1
    assert read_config(folders[0])["settings"]["out"] == str(folders[0])
