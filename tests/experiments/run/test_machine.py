"""What is asked of a machine before a run begins."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from coim.experiments.run.machine import check_compiler


@pytest.fixture(autouse=True)
def a_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.which", lambda name: f"/usr/bin/{name}")


@pytest.mark.skipif(not hasattr(os, "ST_NOEXEC"), reason="only Linux tells how a folder is mounted")
@pytest.mark.parametrize("folder", ["", "a cache/that is/not made yet"])
def test_code_that_could_not_be_loaded_is_not_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str
) -> None:
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / folder))
    check_compiler()
    mounts = {tmp_path: os.ST_NOEXEC}
    monkeypatch.setattr("os.statvfs", lambda path: SimpleNamespace(f_flag=mounts.get(Path(path), 0)))
    with pytest.raises(ValueError, match=r"is mounted noexec; .* TORCHINDUCTOR_CACHE_DIR, or --no-compile") as refusal:
        check_compiler()
    assert f"put into {tmp_path / folder} and" in str(refusal.value)


def test_without_a_folder_of_its_own_compiled_code_goes_where_temporary_files_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("TORCHINDUCTOR_CACHE_DIR", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    check_compiler()
    monkeypatch.setattr("os.access", lambda path, mode: Path(path) != tmp_path)
    with pytest.raises(ValueError, match=f"put into {tmp_path} and loaded from there, which cannot be written to"):
        check_compiler()
