"""The atlas without a browser: what the page holds, of runs with and without networks."""

from __future__ import annotations

import base64
import json
import re
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny_runs import run

from coim import HopperMorph, load_run
from coim.experiments.atlas import alike, gains, walkers
from coim.experiments.atlas.gains import Gain, gains_by_critics, gains_by_returns, in_words
from coim.experiments.atlas.simulator import read_simulator
from coim.experiments.commands.atlas import main
from tests.experiments.report.made_up_run import write_run

BEST = torch.tensor([1.0, 1.0, 1.0, 2.0], dtype=torch.float64)  # the foot is at its upper bound


def data_of(page: Path) -> dict[str, Any]:
    """The numbers that a page holds."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text(), re.DOTALL)
    assert found is not None
    return json.loads(found[1])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(tmp_path_factory.mktemp("atlas") / "run", num_designs=4, imagine="none", episode_steps=60)


@pytest.fixture(scope="module")
def page(folder: Path) -> Path:
    main([str(folder)])
    return folder / "atlas.html"


def test_the_page_has_every_body_its_return_and_a_walk(page: Path, folder: Path) -> None:
    (part,) = data_of(page)["runs"]
    tried = load_run(folder).designs
    assert [body["best"] for body in part["bodies"]] == [pytest.approx(design.best_return) for design in tried]
    assert part["best"] == int(np.argmax([design.best_return for design in tried]))
    assert sorted(map(int, part["walks"])) == [1, 2, 3, 4]
    assert len(part["gains"]["critics"]) == 4
    assert list(part["policies"]) == ["of all bodies", f"of body {tried[part['best']].number}"]


def test_the_command_says_why_a_page_only_plays_recorded_walks(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    main([str(folder), "--out", str(tmp_path)])
    assert (
        "simulates none: a browser needs MuJoCo for it: npm pack @mujoco/mujoco, and --mujoco"
        in capsys.readouterr().err
    )
    simulated = ["--mujoco", str(package(tmp_path, "@mujoco/mujoco")), "--out", str(tmp_path)]
    main([str(folder), *simulated])
    assert "recorded" not in capsys.readouterr().err

    def refuse(body: object) -> None:
        raise ValueError("geom_friction depends on its design")

    monkeypatch.setattr(walkers, "written_body", refuse)
    main([str(folder), *simulated])
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "recorded" in line]
    assert line.endswith("simulates none: geom_friction depends on its design")


def test_a_page_fetches_nothing(page: Path) -> None:
    text = page.read_text()
    assert re.findall(r'(?:src|href)="(?!data:)[^"]*"', text) == []
    assert "NaN" not in json.dumps(data_of(page))


def test_the_arrays_of_a_policy_give_its_action(folder: Path) -> None:
    policy = load_run(folder, run=0).population.policy
    table = walkers.policy_table(policy)
    observation, design = torch.randn(1, 11), torch.full((1, 4), 1.3)
    values = np.concatenate(
        [
            observation[0].numpy() / table["observation_scale"],
            (design[0].numpy() - table["design_centre"]) / table["design_reach"],
        ]
    )
    for layer in table["layers"]:
        bias, weights = (np.frombuffer(base64.b64decode(layer[name]), "<f4") for name in ("bias", "weights"))
        values = values.clip(min=0) if layer is not table["layers"][0] else values
        values = values @ weights.reshape(-1, layer["width"]) + bias
    wanted = policy.deterministic_action(observation, design)[0].detach()
    np.testing.assert_allclose(np.tanh(values), wanted, atol=1e-5)


def test_a_recorded_walk_is_the_episode(folder: Path) -> None:
    saved = load_run(folder, run=0)
    design = torch.tensor([1.0, 1.2, 1.0, 1.0])
    walk = walkers.record_walk(saved.bodies, saved.population.policy, design)
    assert walk.frames.shape == (15, 4, 6)  # 60 steps of 8 ms at 30 frames a second
    assert walk.observation.shape == (60, 11)
    torso = walk.frames[:, 0]  # its centre's height is the first entry of the observation
    np.testing.assert_allclose(torso[:, [2, 5]].mean(1), walk.observation[::4, 0], atol=1e-6)


def test_several_runs_are_compared_also_without_networks(tmp_path: Path) -> None:
    told = {"expected": [None, None, None, 3.0], "deviation": [None, None, None, 1.0]}
    folders = [write_run(tmp_path / name, returns, told=told) for name, returns in
               (("a", [1.0, 2.0, 3.0, 4.0]), ("b", [4.0, 3.0, 2.0, 1.0]))]  # fmt: skip
    main([*map(str, folders), "--out", str(tmp_path)])
    data = data_of(tmp_path / "atlas.html")
    assert [part["best"] for part in data["runs"]] == [3, 0]
    body = data["runs"][0]["bodies"][3]
    assert (body["expected"], round(body["low"], 2), round(body["high"], 2)) == (3.0, 1.36, 4.64)
    # The torsos are 1.3 and 1.0 of 0.5 to 2.0: a fifth of the range, in one of four lengths.
    assert data["distances"] == [[0.0, 0.1], [0.1, 0.0]]
    assert data["runs"][0]["notes"][0].startswith("No policy and no gradient")
    assert "In 1 of 2 runs the best body is one that all runs were given" in (tmp_path / "atlas.html").read_text()


def test_bodies_that_agree_are_told_from_chance() -> None:
    low, high = np.zeros(4), np.ones(4)
    same = alike.in_words(alike.distances(np.full((5, 4), 0.5), low, high), 4, ["optimised"] * 5)
    assert same.startswith("Mean distance of the best bodies of 5 runs: 0.00")
    assert "more alike than chance" in same
    corners = np.array([[0, 0, 0, 0], [1, 1, 1, 1.0]])
    assert "less alike than chance" in alike.in_words(alike.distances(corners, low, high), 4, ["optimised", "random"])
    assert alike.mean_distance(alike.distances(corners, low, high)) == 1


def test_bodies_that_every_run_was_given_are_no_agreement() -> None:
    table = alike.distances(np.array([[0.5] * 4] * 3 + [[1.0] * 4]), np.zeros(4), np.ones(4))
    said = alike.in_words(table, 4, ["first", "first", "optimised", "random"])
    assert said.startswith("In 2 of 4 runs the best body is one that all runs were given. Mean distance")
    assert "best bodies of 2 runs: 0.50" in said
    said = alike.in_words(table[:3, :3], 4, ["first", "first", "optimised"])
    assert said.endswith("Too few remain to say whether what the runs found is more alike than chance.")


class Rising(torch.nn.Module):
    """Critics that know a body by its thigh alone: 100 and 200 for each unit of it."""

    def values(self, observation: torch.Tensor, action: torch.Tensor, design: torch.Tensor) -> torch.Tensor:
        return torch.stack([100 * design[..., 1], 200 * design[..., 1]], -1)


def test_the_gain_by_critics_is_their_gradient_in_units_of_a_return(folder: Path) -> None:
    saved = load_run(folder, run=0)
    walk = walkers.record_walk(saved.bodies, saved.population.policy, torch.ones(4))
    agent = type(saved.population)(saved.population.policy, Rising())  # type: ignore[arg-type]
    found = gains_by_critics(saved.bodies, agent, [walk, walk], BEST, gamma=0.99)
    assert found[0] == Gain(0, 0, 0)
    # A tenth of the thigh is 0.1: 10 and 20 of discounted value, 0.1 and 0.2 a step, times 60 steps.
    assert [found[1].value, found[1].low, found[1].high] == pytest.approx([9, 6, 12], rel=1e-4)


def test_the_gain_by_returns_follows_the_returns(folder: Path) -> None:
    saved = load_run(folder, run=0)
    walk = walkers.record_walk(saved.bodies, saved.population.policy, torch.ones(4))
    low, high = (bound.float() for bound in saved.bodies.design_bounds())
    designs = low + (high - low) * torch.rand(40, 4, generator=torch.Generator().manual_seed(0))
    found = gains_by_returns(saved.bodies, saved.population, [walk], designs, 100 * designs[:, 1], BEST)
    assert found[1].is_clear
    assert found[1].value == pytest.approx(10, abs=4)
    assert all(abs(gain.value) < abs(found[1].value) / 2 for i, gain in enumerate(found) if i != 1)


def test_a_length_at_the_bound_at_which_it_gains_is_left_out() -> None:
    env = HopperMorph(seed=0)
    estimates = [Gain(1, -1, 3), Gain(-5, -9, -1), Gain(2, 1, 3), Gain(50, 40, 60)]
    words = in_words(estimates, env.design_names(), env, BEST)
    assert words.startswith("a thigh shorter by a tenth would gain most: +5 (+1 to +9)")
    assert words.endswith("at its bound already: foot")
    unclear = in_words([Gain(1, -1, 3)] * 4, env.design_names(), env, BEST)
    assert "no direction is certain" in unclear


def test_the_step_over_a_bound_is_shortened() -> None:
    shorter, longer = gains._neighbours(HopperMorph(seed=0), BEST)
    assert (longer - shorter).diagonal().tolist() == pytest.approx([0.2, 0.2, 0.2, 0.2])
    assert longer[3, 3] == 2


def package(folder: Path, name: str) -> Path:
    """An archive such as npm packs."""
    inner = folder / "package"
    inner.mkdir()
    about = {"name": name, "version": "3.14.0", "license": "Apache-2.0"}
    for file, text in (("package.json", json.dumps(about)), ("mujoco.js", "export default 1"), ("mujoco.wasm", "x")):
        (inner / file).write_text(text)
    with tarfile.open(folder / "mujoco.tgz", "w:gz") as archive:
        archive.add(inner, "package")
    return folder / "mujoco.tgz"


def test_the_simulator_is_read_from_an_archive_or_a_folder(tmp_path: Path) -> None:
    archive = package(tmp_path, "@mujoco/mujoco")
    found = read_simulator(archive)
    assert (found.version, found.licence) == ("3.14.0", "Apache-2.0")
    assert read_simulator(tmp_path) == found
    assert base64.b64decode(found.binary)[:2] == b"\x1f\x8b"  # gzip


@pytest.mark.parametrize("name", ["mujoco-js", None])
def test_another_package_or_none_is_refused_with_the_way_to_get_it(tmp_path: Path, name: str | None) -> None:
    path = tmp_path / "mujoco.tgz" if name is None else package(tmp_path, name)
    with pytest.raises(SystemExit, match=r"is no package @mujoco/mujoco .*npm pack @mujoco/mujoco"):
        main([str(tmp_path), "--mujoco", str(path)])
