"""What a script finds in a run's folder, and what it is told where it finds nothing."""

from __future__ import annotations

import json
import shutil
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from interrupted_runs import cut
from tiny_runs import run

import coim.experiments.train
from coim import CoAdaptation, load_run, run_episode, select_run

Made = tuple[Path, CoAdaptation]


def make(folder: Path, **settings: object) -> Made:
    """A finished run and the algorithm that made it."""
    made, build = [], coim.experiments.train.build

    def building(*args: object, **kwargs: object) -> CoAdaptation:
        made.append(build(*args, **kwargs))
        return made[0]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("coim.experiments.train.build", building)
        run(folder, **settings)
    return folder, made[0]


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return make(tmp_path_factory.mktemp("single") / "run", imagine="none", num_designs=1)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return make(tmp_path_factory.mktemp("fleet") / "run", num_runs=2, num_designs=6, first_episodes=3)


def copied(made: Made, folder: Path) -> Path:
    shutil.copytree(made[0], folder)
    return folder


def equal(one: torch.nn.Module, other: torch.nn.Module) -> bool:
    states = one.state_dict(), other.state_dict()
    return states[0].keys() == states[1].keys() and all(map(torch.equal, states[0].values(), states[1].values()))


@pytest.mark.parametrize("name", ["single", "fleet"])
def test_the_networks_are_those_that_learnt(name: str, request: pytest.FixtureRequest) -> None:
    folder, algorithm = request.getfixturevalue(name)
    loaded = load_run(folder)
    for agent, learner in ((loaded.population, algorithm.population), (loaded.individual, algorithm.individual)):
        assert equal(agent.policy, learner.policy)
        assert equal(agent.qvalue, learner.qvalue)
    assert not equal(loaded.population.policy, loaded.individual.policy)
    if algorithm.dynamics is None:
        assert loaded.ensemble is None
    else:
        assert loaded.ensemble is not None
        assert equal(loaded.ensemble, algorithm.dynamics.ensemble)
        assert loaded.ensemble.inputs.count.min() > 0


def test_the_best_evaluation_of_every_design_can_be_played_again(fleet: Made) -> None:
    loaded = load_run(fleet[0])
    assert len(loaded.designs) == 2 * 6
    for number in range(1, 7):
        played = loaded.best_episode(number)
        tried = [design for design in loaded.designs if design.number == number]
        returns = played["next", "reward"].sum(0).flatten().tolist()
        assert returns == pytest.approx([design.best_return for design in tried], rel=1e-6)
        assert torch.allclose(played["design"][0], torch.stack([design.design for design in tried]), rtol=1e-6)


def test_the_best_evaluation_of_a_native_run_is_played_again_to_the_last_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = run(tmp_path / "run", num_runs=2, native_episodes=True, episode_steps=80)
    loaded = load_run(folder)
    for number in (1, 4):
        returns = loaded.best_episode(number)["next", "reward"].sum(0).flatten().tolist()
        expected = [tried.best_return for tried in loaded.designs if tried.number == number]
        assert returns == pytest.approx(expected, rel=1e-6)
        alone = load_run(folder, run=1).best_episode(number)["next", "reward"].sum()
        assert float(alone) == pytest.approx(expected[1], rel=1e-6)
    with monkeypatch.context() as patched:
        patched.setattr("coim.saved_run.can_be_native", lambda: False)  # a machine without a compiler
        in_python = loaded.best_episode(1)["action"]
    assert not torch.equal(in_python, loaded.best_episode(1)["action"])
    torch.testing.assert_close(in_python[:9], loaded.best_episode(1)["action"][:9], rtol=0, atol=1e-4)


def test_a_run_is_opened_as_it_was_whatever_torchs_default_dtype(fleet: Made) -> None:
    expected = load_run(fleet[0])
    torch.set_default_dtype(torch.float64)
    try:
        loaded = load_run(fleet[0])
        assert torch.equal(loaded.best_episode(1)["action"], expected.best_episode(1)["action"])
    finally:
        torch.set_default_dtype(torch.float32)
    assert equal(loaded.population.policy, expected.population.policy)
    assert all(torch.equal(one.design, other.design) for one, other in zip(loaded.designs, expected.designs))
    assert loaded.designs[0].design.dtype == torch.float32


def test_a_design_keeps_its_best_policy_and_not_its_last(fleet: Made) -> None:
    folder, algorithm = fleet
    best, last = load_run(folder).policy_of(6), algorithm.individual.policy
    rows = (folder / "evaluations.csv").read_text().splitlines()
    returns = [[float(row.split(",")[9]) for row in rows if row.startswith(f"{run},6,")] for run in range(2)]
    for k, (first, second) in enumerate(returns):
        assert equal(select_run(best, k), select_run(last, k)) == (second > first)
    assert len({first > second for first, second in returns}) == 2, "this seed has one run of each kind"


def test_one_of_several_runs_has_no_run_axis(fleet: Made) -> None:
    folder, algorithm = fleet
    loaded = load_run(folder, run=1)
    assert equal(loaded.population.policy, select_run(algorithm.population.policy, 1))
    assert equal(loaded.individual.qvalue, select_run(algorithm.individual.qvalue, 1))
    assert loaded.ensemble is not None
    assert loaded.ensemble.num_runs is None
    assert [design.run for design in loaded.designs] == [1] * 6
    tried = loaded.designs[5]
    played = loaded.best_episode(6)["next", "reward"]
    assert played.shape == (6, 1, 1)
    assert float(played.sum()) == pytest.approx(tried.best_return, rel=1e-4)  # alone, products round differently
    rows = run_episode(loaded.bodies, loaded.policy_of(6), design=tried.design[None])
    assert rows.shape == (6, 1)


def test_the_only_run_may_be_named(single: Made) -> None:
    assert equal(load_run(single[0], run=0).policy_of(1), load_run(single[0]).policy_of(1))


def test_a_damaged_checkpoint_is_left_for_the_one_before_it_and_nothing_is_touched(fleet: Made, tmp_path: Path) -> None:
    folder = copied(fleet, tmp_path / "run")
    newest = max((folder / "checkpoint").glob("checkpoint-*/components/*-algorithm/state.pt"))
    newest.write_bytes(newest.read_bytes()[:-1])
    before = {path: path.stat().st_mtime for path in folder.rglob("*")}
    with pytest.warns(UserWarning, match=r"is damaged \(.*state.pt not as written\); reading checkpoint-0"):
        loaded = load_run(folder)
    assert not equal(loaded.individual.policy, fleet[1].individual.policy)
    assert {path: path.stat().st_mtime for path in folder.rglob("*")} == before


def test_what_is_no_run_or_no_run_yet_is_said(fleet: Made, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"holds no run: .*config.json cannot be read"):
        load_run(tmp_path)
    folder = cut(tmp_path / "early", 0)
    with pytest.raises(ValueError, match="has no checkpoint yet"):
        load_run(folder)
    with pytest.raises(ValueError, match=r"run 2 is not in .*, which has runs 0 .. 1"):
        load_run(fleet[0], run=2)
    with pytest.raises(ValueError, match=r"no policy of design 7: there are designs \[1, 2, 3, 4, 5, 6\]"):
        load_run(fleet[0]).policy_of(7)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('"hopper"', '"snake"', "'snake' is none of half_cheetah, hopper, walker, ant; give its class as body="),
        ('"num_cells"', '"cells"', "has no setting 'num_cells'; load it with the version"),
        ('"settings"', '"options"', "names no environment and settings"),
        ("{", "", "config.json is damaged"),
        ('"num_critics": 2', '"num_critics": 3', r"qvalue.layers.0.weight is \(2, .* in the state and \(3, "),
    ],
)
def test_a_folder_of_another_version_is_refused(
    single: Made, tmp_path: Path, old: str, new: str, sentence: str
) -> None:
    config = copied(single, tmp_path / "run") / "config.json"
    config.write_text(config.read_text().replace(old, new, 1))
    with pytest.raises(ValueError, match=sentence):
        load_run(config.parent)


def test_a_checkpoint_of_another_format_is_refused(
    single: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coim.checkpoints.FORMAT", 3)
    with pytest.raises(ValueError, match="has format 2, this version writes 3; go on with the version"):
        load_run(single[0])


def test_a_run_that_is_going_on_can_be_opened(tmp_path: Path) -> None:
    folder = cut(tmp_path / "going on", 5)  # in the second design
    loaded = load_run(folder)
    assert [design.number for design in loaded.designs] == [1]
    assert loaded.policy_of(1).num_runs is None
    assert json.loads((folder / "config.json").read_text())["settings"] == loaded.settings


def test_a_new_design_begins_without_a_best_policy(fleet: Made) -> None:
    """Were the best of the design before it still held, no later one could ever be worse."""
    best = [torch.load(fleet[0] / "policies" / f"design-{i}.pt", weights_only=True)["return"] for i in range(1, 7)]
    assert any((later < earlier).any() for earlier, later in pairwise(best))
