"""Films of a run: whose, how many frames, at which speed; and what is said when there can be none."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from imageio_ffmpeg import get_ffmpeg_exe
from PIL import Image
from tiny_runs import run

from coim import TriedDesign, load_run, run_episode
from coim.experiments.commands.watch import main
from coim.experiments.drawing.film import choose, take
from coim.experiments.drawing.footage import Take, labelled, side_by_side, write_film


def tried(run: int, number: int, best_return: float) -> TriedDesign:
    return TriedDesign(run, number, "first", torch.ones(4), 0.0, best_return)


RETURNS = {0: [3.0, 1.0, 2.0, 7.0, 5.0, 6.0], 1: [1.0, 9.0, float("nan"), 0.0, 4.0, 2.0]}
DONE = SimpleNamespace(
    folder="runs/a", designs=[tried(r, i + 1, x) for r, xs in RETURNS.items() for i, x in enumerate(xs)]
)


@pytest.mark.parametrize(
    ("design", "run", "expected"),
    [
        ("best", None, [(1, 2)]),
        ("best", 0, [(0, 4)]),
        ("top5", 0, [(0, 4), (0, 6), (0, 5), (0, 1), (0, 3)]),
        ("top5", None, [(1, 2), (1, 5), (1, 6), (1, 1), (1, 4)]),
        ("all", 0, [(0, i) for i in range(1, 7)]),
        ("all", 1, [(1, i) for i in (1, 2, 4, 5, 6)]),  # the third has no return
        ("6", None, [(0, 6)]),
        ("6", 1, [(1, 6)]),
        ("5,1,2", None, [(1, 5), (1, 1), (1, 2)]),
    ],
)
def test_the_designs_that_are_asked_for(design: str, run: int | None, expected: list[tuple[int, int]]) -> None:
    assert [(found.run, found.number) for found in choose(DONE, design, run)] == expected


@pytest.mark.parametrize(
    ("design", "run", "sentence"),
    [
        ("worst", None, r"--design is 'worst': choose best, top5, all or numbers of .* \[1, 2, 3, 4, 5, 6\]"),
        ("3,1", 1, r"--design is '3,1': .* of run 1, \[1, 2, 4, 5, 6\]"),
        ("3", 1, r"--design is '3': .* of run 1, \[1, 2, 4, 5, 6\]"),  # the third has no return
        ("best", 2, "no design of run 2 in runs/a has a return yet"),
    ],
)
def test_a_design_that_is_not_there_is_refused(design: str, run: int | None, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        choose(DONE, design, run)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--width", "65"], "width is 65, it must be even"),
        (["--steps", "0"], "steps is 0"),
        (["--pretrained", "hopper"], "name the folder of a run or --pretrained .*hopper.*, one of the two"),
    ],
)
def test_what_cannot_be_filmed_is_refused(tmp_path: Path, words: list[str], sentence: str) -> None:
    with pytest.raises(SystemExit, match=sentence):
        main([str(tmp_path), *words])


def test_a_folder_without_a_run_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"^/.* holds no run"):
        main([str(tmp_path)])


def test_five_pictures_stand_in_two_lines_and_the_sixth_place_is_white() -> None:
    grid = side_by_side([np.full((10, 20, 3), i, np.uint8) for i in range(5)])
    assert grid.shape == (2 * 14, 3 * 24, 3)
    assert [[int(grid[y, x, 0]) for x in (5, 29, 53)] for y in (5, 19)] == [[0, 1, 2], [3, 4, 255]]


def test_a_label_is_dark_on_light_and_leaves_the_rest_alone() -> None:
    picture = np.full((120, 160, 3), 90, np.uint8)
    shown = labelled(picture, ("design 7, random: best return 123.4",))
    assert shown[:20].max() > 180
    assert shown[:20].min() < 40
    assert (shown[40:] == 90).all()


def test_the_entries_of_a_design_stand_below_the_label_in_as_many_lines_as_they_need() -> None:
    picture, line = np.full((240, 320, 3), 90, np.uint8), ("design 7, random: best return 123.4",)

    def height(*entries: str) -> int:
        return int((labelled(picture, line, entries) != 90).any((1, 2)).sum())

    bare = height()
    assert height("torso 1.26", "foot 0.5") == bare + 16  # a line is 1.3 times as high as its letters of 12 pixels
    assert height(*["right thigh 1.33"] * 4) > height("torso 1.26", "foot 0.5")
    assert height(*["right thigh 1.33"] * 60) == bare  # they would hide the body


def watch(folder: Path, *options: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """The command, in a process that has no screen."""
    chosen = {"MUJOCO_GL", "PYOPENGL_PLATFORM"}  # the second by mujoco, for whoever has set the first
    clean = {name: value for name, value in os.environ.items() if "DISPLAY" not in name and name not in chosen}
    return subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "-m", "coim.experiments", "watch", str(folder), *options],
        env=clean | environment, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(tmp_path_factory.mktemp("fleet") / "run", num_runs=2, num_designs=3, imagine="none", episode_steps=60)


def test_what_is_filmed_is_the_evaluation_with_the_best_return(fleet: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coim.envs.morph.MorphEnv.camera", lambda *args, **kwargs: None)
    loaded = load_run(fleet)
    for design in loaded.designs:
        shot, rows = take(loaded, design, "best", 64, 64), loaded.best_episode(design.number)[:, design.run]
        assert shot.returned[-1] == pytest.approx(design.best_return, rel=1e-6)
        assert torch.allclose(torch.tensor(shot.poses[:-1, 1]).float(), rows["observation"][:, 0])  # height
        assert torch.allclose(torch.tensor(shot.speed[1:]).float(), rows["next", "observation"][:, 5])
        assert shot.poses.shape == (61, 6)


def test_films_move_at_the_speed_at_which_it_happened(fleet: Path) -> None:
    said = watch(fleet, "--design", "top5", "--run", "1", "--width", "96", "--height", "64")
    if "no picture without OpenGL" in said.stderr or "names an OpenGL library that is missing" in said.stderr:
        assert "libegl1 libegl-mesa0" in said.stderr
        alone = [sys.executable, "-c", "import mujoco; mujoco.GLContext(8, 8).make_current()"]
        drawn = subprocess.run(alone, env=os.environ | {"MUJOCO_GL": "egl"}, capture_output=True, check=False)
        assert drawn.returncode != 0, "MuJoCo alone draws by EGL here"
        pytest.skip("there is no EGL to draw with")
    assert said.returncode == 0, said.stderr
    path = fleet / "videos" / "run-1-top5.mp4"
    assert said.stdout.split() == [str(path)]
    assert said.stderr.splitlines() == [f"reading {fleet}", "run-1-top5.mp4: pictures: 0 of 13"]
    assert [found.name for found in path.parent.iterdir()] == [path.name]
    read = subprocess.run(
        [get_ffmpeg_exe(), "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"], capture_output=True, check=True
    )
    width, height = 2 * 100, 2 * 68
    assert f", {width}x{height}" in read.stderr.decode()
    assert ", 25 fps" in read.stderr.decode()  # every fifth step of 0.008 s
    frames = np.frombuffer(read.stdout, np.uint8).reshape(-1, height, width, 3).astype(int)
    assert len(frames) == 60 // 5 + 1
    for one, other in ((0, 6), (6, 12)):
        moved = np.abs(frames[one] - frames[other])[40:64]  # below the label
        for left, right in ((0, 96), (100, 196)):
            assert moved[:, left:right].mean() > 0.5


@pytest.fixture
def copied(fleet: Path, tmp_path: Path) -> Path:
    """The run in a folder from which its policies were left away."""
    return shutil.copytree(fleet, tmp_path / "copied", ignore=shutil.ignore_patterns("policies", "videos"))


@pytest.fixture
def filmed(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Path, list[Take]]]:
    """Films that would have been written."""
    films: list[tuple[Path, list[Take]]] = []
    monkeypatch.setattr("coim.envs.morph.MorphEnv.camera", lambda *args, **kwargs: None)
    monkeypatch.setattr("coim.experiments.drawing.film.write_film", lambda path, takes: films.append((path, takes)))
    return films


def test_a_run_without_its_policies_is_filmed_with_that_of_the_population(copied: Path, filmed: list) -> None:
    with pytest.raises(SystemExit, match=r"keeps no policy of design 2; add --policy population to film"):
        main([str(copied), "--design", "2", "--run", "1"])
    main([str(copied), "--design", "2", "--run", "1", "--policy", "population"])
    ((path, (shot,)),) = filmed
    assert path == copied / "videos" / "run-1-design-2-population.mp4"
    loaded = load_run(copied, run=1)
    design = next(tried.design for tried in loaded.designs if tried.number == 2)
    alone = run_episode(loaded.bodies, loaded.population.policy, design=design[None], deterministic=True)
    assert shot.poses.shape == (61, 6)
    assert shot.design.equal(design)
    assert abs(shot.poses[0, 1] - float(alone["observation"][0, 0, 0])) < 0.02  # another start of the same body


def test_films_of_a_folder_that_is_not_ours_go_where_out_says(
    fleet: Path, filmed: list, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    main([str(fleet), "--design", "1", "--run", "0", "--out", str(tmp_path / "films")])
    assert [path for path, _ in filmed] == [tmp_path / "films" / "run-0-design-1.mp4"]

    def refuse(folder: Path, **_: object) -> None:
        raise PermissionError(13, "Permission denied", str(folder))

    monkeypatch.setattr("pathlib.Path.mkdir", refuse)
    shot = SimpleNamespace(step_seconds=0.01, poses=np.zeros((2, 6)), frames=lambda stride: iter(()))
    with pytest.raises(OSError, match=r"/videos cannot be written to \(Permission denied\); .* with --out"):
        write_film(fleet / "videos" / "film.mp4", [shot])


def test_a_body_that_is_not_ours_is_filmed_if_its_class_is_named(copied: Path, filmed: list) -> None:
    config = json.loads((copied / "config.json").read_text())
    (copied / "config.json").write_text(json.dumps(config | {"environment": "their_hopper"}))
    with pytest.raises(SystemExit, match=r"a run of 'their_hopper', .* with --body module:Class"):
        main([str(copied)])
    main([str(copied), "--policy", "population", "--body", "coim.envs.hopper:HopperMorph"])
    assert len(filmed) == 1


def test_without_a_way_to_draw_one_sentence_says_what_to_install(fleet: Path) -> None:
    said = watch(fleet, MUJOCO_GL="osmesa")
    if said.returncode == 0:
        pytest.skip("OSMesa is installed")
    assert said.returncode == 1
    assert said.stderr.splitlines()[-1].startswith("ImportError: MUJOCO_GL=osmesa names an OpenGL library")
    assert "apt-get install libegl1" in said.stderr


def test_a_trained_robot_of_the_package_is_filmed_for_five_seconds_where_one_stands(
    filmed: list, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pytest.importorskip("safetensors")
    monkeypatch.chdir(tmp_path)
    main(["--pretrained", "hopper"])
    ((path, (shot,)),) = filmed
    assert path == Path("hopper.mp4")
    assert len(shot.poses) == 625 + 1  # steps of 0.008 s
    assert shot.poses[-1, 0] > 2.0  # m: it moves forward
    with pytest.raises(SystemExit, match=r"is one policy: leave out --run and --policy"):
        main(["--pretrained", "hopper", "--run", "0"])
    with pytest.raises(SystemExit, match=r"--pretrained is 'ostrich': there are .*hopper"):
        main(["--pretrained", "ostrich"])


def test_an_animated_picture_repeats_at_the_speed_at_which_it_happened(tmp_path: Path) -> None:
    pictures = [np.full((32, 48, 3), 60 * i, np.uint8) for i in range(4)]
    shot = SimpleNamespace(step_seconds=0.008, poses=np.zeros((28, 6)), frames=lambda stride: iter(pictures))
    write_film(tmp_path / "film.webp", [shot])
    with Image.open(tmp_path / "film.webp") as film:
        assert (film.n_frames, film.size, film.info["loop"]) == (4, (48, 32), 0)
        film.seek(1)
        film.load()
        assert film.info["duration"] == 72  # ms: every ninth step
