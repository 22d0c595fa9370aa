"""A policy taken out of a run: the files act as it does, the body is the same, and what cannot be is said."""

from __future__ import annotations

import csv
import json
import shutil
import sys
from pathlib import Path

import mujoco
import pytest
import torch
from interrupted_runs import run

from coim import HopperMorph, load_run
from coim.envs.blueprint import observed
from coim.experiments.commands import evaluate, export
from coim.experiments.export import actor, write
from coim.experiments.export.evaluation import EVALUATION
from coim.experiments.frames import read_frame
from coim.models import Policy, PolicyNetwork, select_run

NEEDS = {".onnx": ("onnx", "onnxruntime"), ".safetensors": ("safetensors",), ".pt2": ()}


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fleet") / "run"
    return run(folder, num_runs=2, num_designs=2, first_episodes=1, imagine="none", episode_steps=8)


def rows_in(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


def evaluated(capsys: pytest.CaptureFixture, *words: str) -> list[str]:
    evaluate.main(list(words))
    return capsys.readouterr().out.splitlines()


def test_the_best_body_of_a_run_comes_with_the_policy_that_earned_it(fleet: Path) -> None:
    loaded = load_run(fleet)
    best = loaded.best
    assert best.tried.best_return == max(tried.best_return for tried in loaded.designs)
    kept = select_run(loaded.policy_of(best.tried.number), best.tried.run)
    states = torch.randn(5, 11), best.tried.design.repeat(5, 1)
    assert torch.equal(best.policy.deterministic_action(*states), kept.deterministic_action(*states))
    other = 3 - best.tried.number
    assert loaded.trained(other).tried.best_return == max(d.best_return for d in loaded.designs if d.number == other)
    with pytest.raises(ValueError, match=r"has no design 7 with a return: there are designs \[1, 2\]"):
        loaded.trained(7)


@pytest.mark.parametrize("suffix", NEEDS)
def test_a_written_policy_acts_as_torchs_on_any_number_of_states(suffix: str, fleet: Path, tmp_path: Path) -> None:
    for package in NEEDS[suffix]:
        pytest.importorskip(package)
    path = tmp_path / f"policy{suffix}"
    best = load_run(fleet).best
    assert write.write_policy(best.policy, path) <= 1e-5
    act = actor.read_policy(path)
    for rows in (1, 7):
        states = torch.randn(rows, 11), best.tried.design.repeat(rows, 1)
        with torch.no_grad():
            assert torch.allclose(act(*states), best.policy.deterministic_action(*states), atol=1e-5)


def test_a_policy_that_would_act_otherwise_is_not_written(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(actor.FORMATS, ".pt2", (lambda actor, path: path.touch(), lambda path: lambda s, d: s[:, :3]))
    with pytest.raises(SystemExit, match=r"acts otherwise than torch, by up to .* instead of 1e-05"):
        export.main([str(fleet), "--to", str(tmp_path / "out" / "policy.pt2")])
    assert list((tmp_path / "out").iterdir()) == []


def test_the_body_beside_it_is_the_one_of_the_run_and_the_readme_says_what_goes_in_and_out(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    path = tmp_path / "policy.pt2"
    export.main([str(fleet), "--to", str(path), "--design", "1,2,0.5,1"])
    files = [tmp_path / name for name in ("policy.pt2", "policy.json", "policy-body.xml", "policy-lengths.csv")]
    assert capsys.readouterr().out.splitlines() == [*map(str, files), str(tmp_path / "README.md")]
    model = mujoco.MjModel.from_xml_path(str(files[2]))
    bodies = HopperMorph(seed=0)
    bodies.reset(bodies.reset().set("design", torch.tensor([[1.0, 2.0, 0.5, 1.0]])))
    assert model.body_mass == pytest.approx(bodies.simulations.model(0).body_mass, rel=1e-6)
    assert model.opt.timestep == bodies.simulations.model(0).opt.timestep
    parts = {row["body"]: float(row["length_m"]) for row in rows_in(files[3])}
    assert parts["torso"] == pytest.approx(0.4)  # m
    assert parts["thigh"] == pytest.approx(2 * 0.45)
    readme = (tmp_path / "README.md").read_text()
    for line in (
        "| control step | 0.008 s: one action is held for 4 steps of MuJoCo |",
        "| 0 | position of rootz | m |",
        "| 1 | angle of rooty, wrapped to (-pi, pi] | rad |",
        "| 10 | angular velocity of foot | rad/s |",
        "| 1 | thigh | 2 | 0.5 - 2 |",
        "| 2 | foot | -200.0 | 200.0 | N m |",
    ):
        assert line in readme
    assert len(observed(bodies)) == 11
    (code,) = (part.split("```")[0] for part in readme.split("```python\n")[1:])
    told: dict[str, torch.Tensor] = {}
    exec(code.replace('"policy.pt2"', f'"{path}"'), told)
    assert told["action"].shape == (1, 3)


def test_an_evaluation_repeats_itself_and_an_exported_policy_earns_the_same(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    table, again, exported = (tmp_path / name for name in ("a.csv", "b.csv", "c.csv"))
    lines = evaluated(capsys, str(fleet), "--episodes", "3", "--out", str(table))
    best = load_run(fleet).best.tried
    assert lines[0].startswith(f"design {best.number} (first): return ")
    assert "in 3 episodes of 8 steps" in lines[0]
    assert lines[-1] == str(table)
    evaluated(capsys, str(fleet), "--episodes", "3", "--out", str(again), "--design", str(best.number))
    assert table.read_text() == again.read_text()
    rows = rows_in(table)
    assert [row["episode"] for row in rows] == ["1", "2", "3"]
    assert len({row["return"] for row in rows}) == 3  # another start for each
    told = {(row["source"], row["policy"], row["run"], row["seed"]) for row in rows}
    assert told == {(str(fleet), "best", str(best.run), "0")}
    assert read_frame(table, EVALUATION)["return"].tolist() == [float(row["return"]) for row in rows]
    export.main([str(fleet), "--to", str(tmp_path / "out" / "policy.pt2")])
    evaluated(capsys, str(tmp_path / "out" / "policy.pt2"), "--episodes", "3", "--out", str(exported))
    for row, other in zip(rows, rows_in(exported), strict=True):
        assert other["source"] == str(tmp_path / "out" / "policy.pt2")
        assert (other["policy"], other["run"]) == ("", "")
        assert float(row["return"]) == pytest.approx(float(other["return"]), rel=1e-4)


def test_lengths_that_are_no_design_have_the_populations_policy(fleet: Path, capsys: pytest.CaptureFixture) -> None:
    lines = evaluated(capsys, str(fleet), "--episodes", "1", "--design", "1,2,0.5,1")
    assert lines[0].startswith("body 1,2,0.5,1, the population's policy: return ")
    assert lines[1] == str(fleet / "evaluation.csv")
    (row,) = rows_in(fleet / "evaluation.csv")
    again = evaluated(capsys, str(fleet), "--episodes", "1", "--design", "best")
    assert again[1].startswith("its best evaluation in the run, the highest if there were several, had ")
    assert again[2] == str(fleet / "evaluation-2.csv")
    assert rows_in(fleet / "evaluation.csv") == [row]
    assert (row["policy"], row["run"]) == ("population", str(load_run(fleet).best.tried.run))
    assert (row["xi_thigh"], row["xi_shank"]) == ("2.0", "0.5")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--design", "worst"), "--design is 'worst': choose best, the number of a design, or factors"),
        (("--design", "9"), r"has no design 9 with a return: there are designs \[1, 2\]"),
        (("--design", "1,1"), r"--design is 1,1, it must be 4 factors: torso in \[0.5, 2\], thigh"),
        (("--design", "1,1,1,9"), r"it must be 4 factors: torso in \[0.5, 2\]"),
        (("--design", "1,1,1,x"), "one of its entries is no number"),
        (("--design", "1,1,1,1", "--policy", "best"), "it has no best policy: --policy population"),
        (("--run", "2"), r"run 2 is not in .*, which has runs 0 .. 1"),
        (("--episodes", "0"), "--episodes is 0, it must be at least 1"),
    ],
)
def test_what_is_not_there_is_said_in_a_sentence(fleet: Path, words: tuple[str, ...], sentence: str) -> None:
    with pytest.raises(SystemExit, match=sentence):
        evaluate.main([str(fleet), *words])


def test_a_missing_package_a_strange_suffix_and_a_foreign_readme_are_said(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in ("safetensors", "safetensors.torch"):
        monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(SystemExit, match=r"safetensors is not installed .*: pip install 'coim\[export\]'"):
        export.main([str(fleet), "--to", str(tmp_path / "policy.safetensors")])
    with pytest.raises(SystemExit, match=r"its suffix must be one of .onnx, .safetensors, .pt2"):
        export.main([str(fleet), "--to", str(tmp_path / "policy.pkl")])
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "README.md").write_text("# My own")
    with pytest.raises(SystemExit, match=r"README.md is not of coim export, and would be lost"):
        export.main([str(fleet), "--to", str(tmp_path / "policy.pt2")])
    with pytest.raises(SystemExit, match=r"nowhere.pt2 does not exist; coim export writes it"):
        evaluate.main([str(tmp_path / "nowhere.pt2")])


def test_a_policy_that_was_not_kept_is_said(fleet: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(fleet, copy)
    shutil.rmtree(copy / "policies")
    with pytest.raises(SystemExit, match="keeps no policy of design"):
        evaluate.main([str(copy)])


def test_only_a_policy_of_ours_becomes_an_actor() -> None:
    with pytest.raises(ValueError, match="take one of K by select_run"):
        actor.Actor.of(Policy(PolicyNetwork(11, 4, 3, num_runs=2)))
    with pytest.raises(ValueError, match="are not the tensors of a policy"):
        actor.Actor({"weight": torch.zeros(1)})


def test_what_is_told_of_the_body_is_json(fleet: Path, tmp_path: Path) -> None:
    export.main([str(fleet), "--to", str(tmp_path / "policy.pt2"), "--policy", "population"])
    told = json.loads((tmp_path / "policy.json").read_text())
    assert told["environment"] == "hopper"
    assert told["settings"] == {"task": "forward", "episode_steps": 8}
    assert torch.equal(torch.tensor(told["design"]), load_run(fleet).best.tried.design)


def test_a_policy_does_not_lose_its_body_to_another_one(fleet: Path, tmp_path: Path) -> None:
    first = tmp_path / "policy.pt2"
    export.main([str(fleet), "--design", "1", "--to", str(first)])
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    for other in ("policy.safetensors", "another.pt2"):
        with pytest.raises(SystemExit, match=r"policy.pt2 lies in this folder with a body and a README of its own"):
            export.main([str(fleet), "--design", "2", "--to", str(tmp_path / other)])
    assert before == {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    export.main([str(fleet), "--design", "1", "--to", str(tmp_path / "policy.safetensors")])  # the same body
    first.unlink()
    (tmp_path / "policy.safetensors").unlink()
    export.main([str(fleet), "--design", "2", "--to", str(first)])


def test_a_folder_whose_name_has_a_dot_is_a_run(fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    shutil.copytree(fleet, tmp_path / "lr0.001")
    assert evaluated(capsys, str(tmp_path / "lr0.001"), "--episodes", "1")[0].startswith("design ")
    with pytest.raises(SystemExit, match="--seed is -1, it must be at least 0"):
        evaluate.main([str(tmp_path / "lr0.001"), "--seed", "-1"])


def test_the_populations_policy_is_not_told_the_best_return_of_another(
    fleet: Path, capsys: pytest.CaptureFixture
) -> None:
    own, population = (
        evaluated(capsys, str(fleet), "--episodes", "1", "--policy", policy) for policy in ("best", "population")
    )
    assert any("its best evaluation in the run, the highest" in line for line in own)
    assert not any("its best evaluation in the run, the highest" in line for line in population)
