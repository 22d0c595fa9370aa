"""The transitions of a run as a dataset: the same numbers, cut where episodes end."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_runs import run

from coim.experiments.commands.dataset import main
from coim.experiments.export.dataset import episodes, replay_of


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fleet") / "run"
    return run(folder, num_runs=2, num_designs=2, first_episodes=1, imagine="none", episode_steps=8)


def test_an_episode_ends_at_its_limit_or_where_its_simulation_broke() -> None:
    rows = {name: torch.zeros(6, 1, 2) for name in ("observation", "next.observation", "design", "next.design")}
    rows["observation"][:, 0, 0] = torch.arange(6.0)
    rows["next.observation"][:, 0, 0] = torch.arange(6.0) + 1
    flags = {"next.terminated": [1], "next.truncated": [3, 5], "next.done": [1, 3, 5]}
    for name, ends in flags.items():
        rows[name] = torch.zeros(6, 1, 1, dtype=torch.bool)
        rows[name][ends] = True
    found = list(episodes(rows | {"action": torch.zeros(6, 1, 1), "next.reward": torch.ones(6, 1, 1)}, 0))
    assert [episode["observations"][:, 0].tolist() for episode in found] == [[0, 1, 2], [2, 3, 4], [4, 5, 6]]
    assert [episode["terminations"].tolist() for episode in found] == [[False, True], [False] * 2, [False] * 2]
    assert [episode["truncations"].tolist() for episode in found] == [[False] * 2, [False, True], [False, True]]


def test_minari_reads_the_episodes_of_a_run_and_makes_its_environment(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    minari = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    size = (fleet / "checkpoint" / "replay.bin").stat().st_size
    main([str(fleet), "--name", "coim/hopper/first-v0"])
    assert capsys.readouterr().out.splitlines() == ["4 episodes, 32 steps", str(tmp_path / "coim/hopper/first-v0")]
    assert (fleet / "checkpoint" / "replay.bin").stat().st_size == size
    dataset, rows = minari.load_dataset("coim/hopper/first-v0"), replay_of(fleet)
    second = dataset[1]  # of run 0
    assert second.observations.shape == (9, 11 + 4)
    assert np.array_equal(second.observations[:-1, :11], rows["observation"][8:, 0].numpy())
    assert np.array_equal(second.observations[0, 11:], rows["design"][8, 0].numpy())
    assert np.array_equal(second.rewards, rows["next.reward"][8:, 0, 0].numpy())
    assert dataset.recover_environment().observation_space.shape == (15,)
    with pytest.raises(SystemExit, match="already exists"):
        main([str(fleet), "--name", "coim/hopper/first-v0"])


def test_a_missing_package_is_said(fleet: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(SystemExit, match=r"h5py is not installed .*: pip install 'coim\[export\]'$"):
        main([str(fleet), "--name", "first-v0"])


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("bad name", "Malformed dataset ID: bad name"),
        ("bad", "'bad' has no version; take a name such as coim/hop"),
    ],
)
def test_a_name_that_minari_refuses_leaves_no_folder(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, sentence: str
) -> None:
    pytest.importorskip("minari")
    pytest.importorskip("h5py")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    with pytest.raises(SystemExit, match=sentence):
        main([str(fleet), "--name", name])
    assert not list(tmp_path.rglob(name))


def test_damaged_rows_are_no_dataset(fleet: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(fleet, copy)
    rows = copy / "checkpoint" / "replay.bin"
    whole = rows.read_bytes()
    for damaged in (bytes(64) + whole[64:], whole[: len(whole) // 8]):
        rows.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"no checkpoint is whole: .*of replay.bin|replay.bin has"):
            replay_of(copy)
