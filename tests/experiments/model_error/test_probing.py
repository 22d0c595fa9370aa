"""What a model of the dynamics is measured against: the simulator, wherever it is put."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from tiny_runs import TINY
from torch import Tensor

from coim import HopperMorph, KnownDesigns, NoisyDesigns, RandomDesigns, make_policy, run_episode
from coim.experiments.model_error.design_space import (
    design_space,
    plane,
    predicted_change,
    principal_directions,
    true_change,
    with_area,
    within,
)
from coim.experiments.model_error.errors import mean_squares, persistence_error, prediction_error
from coim.experiments.model_error.placed_simulator import PlacedSimulator
from coim.experiments.model_error.run import probe, write_design_space
from coim.experiments.model_error.test_rows import NEVER_BUILT, Probes, joined
from coim.pairs import IN_THE_FLOOR

BOUNDS = tuple(bound.float() for bound in HopperMorph.design_bounds())


class Perfect:
    """The simulator as an ensemble of two members that agree."""

    def __init__(self) -> None:
        self.simulator = PlacedSimulator(HopperMorph, size=32)

    def moments(self, observation: Tensor, action: Tensor, design: Tensor) -> tuple[Tensor, Tensor]:
        flat = (x.reshape(-1, x.shape[-1]) for x in (observation, action, design))
        following = self.simulator.step(*flat).next_observation.reshape(observation.shape)
        means = torch.stack([following, following], -2)
        return means, torch.ones_like(means)

    @staticmethod
    def wrapped(x: Tensor) -> Tensor:
        pitch = torch.zeros(11, dtype=torch.bool)
        pitch[1] = True
        return torch.where(pitch, torch.remainder(x + math.pi, 2 * math.pi) - math.pi, x)


@pytest.fixture(scope="module")
def rows() -> TensorDict:
    """An episode of two runs under random actions, ``[60, 2]``."""
    env = HopperMorph(num_runs=2, episode_steps=60, seed=0)
    designs = torch.tensor([[1.0, 1.0, 1.0, 1.0], [1.5, 0.6, 0.9, 2.0]])
    return run_episode(env, None, design=designs, rng=torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def probes() -> Probes:
    return Probes(HopperMorph, num_runs=2, episode_steps=20, num_rows=12)


def by_hand(observation: Tensor, action: Tensor, design: Tensor) -> Tensor:
    """One step of one hopper, its joints set one by one."""
    env = HopperMorph(num_runs=1, seed=0)
    env.reset(TensorDict({"design": design[None]}, [1]))
    env.simulations.qpos[0] = [0.0, *observation[:5].double()]
    env.simulations.qvel[0] = observation[5:].double()
    return env.advance(action[None])[0][0]


def test_the_simulator_itself_makes_no_error_and_no_change_does(rows: TensorDict) -> None:
    still = torch.ones(11)
    valid = ~rows["next", "terminated"][..., 0]
    perfect, nothing = (
        mean_squares(error(Perfect(), rows), still, valid)[0] for error in (prediction_error, persistence_error)
    )
    assert perfect.max() < 1e-8
    assert nothing.min() > 1e-2


def test_the_error_of_an_ensemble_is_that_of_its_mean_also_beside_the_cut_of_an_angle() -> None:
    class Split(Perfect):
        def moments(self, observation: Tensor, action: Tensor, design: Tensor) -> tuple[Tensor, Tensor]:
            means = torch.zeros(1, 1, 2, 11)
            means[..., 0, 1], means[..., 1, 1] = math.pi - 0.1, 0.3 - math.pi  # the mean is pi + 0.1
            means[..., 0, 5], means[..., 1, 5] = 1.0, 3.0
            return means, means

    state = torch.zeros(1, 1, 11)
    following = state.clone()
    following[..., 1], following[..., 5] = math.pi, 1.5
    empty = {"observation": state, "action": torch.zeros(1, 1, 3), "design": torch.ones(1, 1, 4)}
    error = prediction_error(Split(), TensorDict(empty | {"next": {"observation": following}}, [1, 1]))
    assert error[0, 0, [0, 1, 5]].tolist() == pytest.approx([0.0, 0.1, 0.5], abs=1e-6)


def test_each_run_has_its_own_error_and_unit_and_rows_that_do_not_count_are_left_out() -> None:
    error = torch.tensor([[[1.0, 3.0], [2.0, 0.0]], [[math.nan, 1.0], [4.0, 0.0]]])  # [R, K, S]
    variance = torch.tensor([[1.0, 9.0], [4.0, 1.0]])
    raw, normalised = mean_squares(error, variance, torch.tensor([[True, True], [False, True]]))
    assert raw.tolist() == [5.0, 5.0]  # (1 + 9) / 2; (4 + 16) / 2 / 2
    assert normalised.tolist() == [1.0, 1.25]  # (1 + 1) / 2; (1 + 4) / 2 / 2


def test_the_truth_of_swapped_designs_is_a_simulator_that_was_set_by_hand(rows: TensorDict, probes: Probes) -> None:
    spec = HopperMorph(seed=0).design_spec
    swapped, impossible = probes.swapped(rows, RandomDesigns(spec), seed=1)
    assert swapped.batch_size == (12, 2)
    assert spec.is_in(swapped["design"])
    assert impossible.any()
    assert not impossible.all()
    stored = {tuple(row) for row in rows["observation"].flatten(0, 1).tolist()}
    for row in swapped.reshape(-1):
        assert tuple(row["observation"].tolist()) in stored
        truth = by_hand(row["observation"], row["action"], row["design"])
        assert torch.allclose(truth, row["next", "observation"], atol=1e-5)


def test_a_swap_that_changes_nothing_finds_what_was_stored_and_noise_is_as_small_as_asked(
    rows: TensorDict, probes: Probes
) -> None:
    known, impossible = probes.swapped(rows, KnownDesigns(), seed=2)
    assert not impossible.any()
    following = {tuple(row["observation"].tolist()): row["next", "observation"] for row in rows.reshape(-1)}
    for row in known.reshape(-1):
        assert torch.allclose(following[tuple(row["observation"].tolist())], row["next", "observation"], atol=1e-4)
    noisy, _ = probes.swapped(rows, NoisyDesigns(HopperMorph(seed=0).design_spec, sigma=1e-3), seed=2)
    moved = (noisy["design"] - known["design"]).abs()  # the same rows are drawn
    assert 0 < moved.max() < 1e-2


def test_how_many_are_placed_at_once_makes_no_difference(rows: TensorDict) -> None:
    flat = rows[:7].reshape(-1)
    designs = RandomDesigns(HopperMorph(seed=0).design_spec)(flat["design"], rng=torch.Generator().manual_seed(3))
    one, other = (
        PlacedSimulator(HopperMorph, size=size).step(flat["observation"], flat["action"], designs) for size in (4, 14)
    )
    assert torch.equal(one.next_observation, other.next_observation)
    assert torch.equal(one.depth, other.depth)


def test_a_longer_leg_reaches_into_the_floor_by_what_it_is_longer() -> None:
    start = HopperMorph(num_runs=1, reset_noise=0, seed=0).reset()["observation"].expand(3, -1)
    designs = torch.tensor([[1.0, 1.0, 1.0, 1.0], [1.0, 1.0, 1.4, 1.0], [1.0, 1.0, 0.5, 1.0]])
    truth = PlacedSimulator(HopperMorph).step(start, torch.zeros(3, 3), designs)
    assert truth.depth.tolist() == pytest.approx([0.0, 0.4 * 0.5 - 0.04, 0.0], abs=1e-6)  # the sole starts 4 cm above
    assert truth.impossible.tolist() == [False, True, False]
    assert IN_THE_FLOOR < 0.16


def test_designs_that_are_never_built_have_trajectories_of_their_own(probes: Probes) -> None:
    env = HopperMorph(num_runs=2, seed=0)
    policy = make_policy(env, num_cells=(8,), num_runs=2)
    found = probes.unseen_trajectories(policy, seed=5)
    assert found.batch_size == (12, 2)
    designs = {tuple(design) for design in found["design"].flatten(0, 1).tolist()}
    assert designs <= {tuple(design) for design in probes.never_built.tolist()}
    assert 1 < len(designs) <= NEVER_BUILT
    again = probes.unseen_trajectories(policy, seed=5)
    assert torch.equal(found["next", "observation"], again["next", "observation"])


def test_the_plane_goes_through_the_design_and_fills_the_bounds() -> None:
    origin = torch.tensor([1.0, 1.0, 1.0, 1.9])
    directions = torch.eye(4)[[0, 3]]
    grid = plane(origin, directions, BOUNDS, side=5)
    assert grid.shape == (25, 2)
    designs = origin + grid @ directions
    assert within(designs, BOUNDS).all()
    assert torch.allclose(designs.amin(0), torch.tensor([0.5, 1.0, 1.0, 0.5]))
    assert torch.allclose(designs.amax(0), torch.tensor([2.0, 1.0, 1.0, 2.0]))
    askew = torch.tensor([[1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0]]) / math.sqrt(2)
    inside = within(origin + plane(origin, askew, BOUNDS, side=21) @ askew, BOUNDS)
    assert inside.float().mean() > 0.6  # the grid is that of the slice, not of the shadow of the whole box


def test_a_plane_through_a_corner_or_along_an_edge_has_no_area_and_one_through_a_face_has() -> None:
    corner, face = torch.full((4,), 2.0), torch.tensor([1.0, 1.0, 1.0, 2.0])
    askew = torch.tensor([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]]) / math.sqrt(2)
    edge = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]]) / torch.tensor([[1.0], [math.sqrt(2)]])
    # The askew plane meets the bounds beside the corner in 0.28 x 0.28 (5 % are 0.34 x 0.34), the face in 1.4 x 1.4.
    designs = torch.stack([corner, face, corner, corner - 0.1])
    assert with_area(designs, askew, BOUNDS).tolist() == [False, True, False, False]
    assert with_area(designs, edge, BOUNDS).tolist() == [False, True, False, True]
    assert with_area(designs, torch.eye(4)[:2], BOUNDS).all()


def test_designs_on_a_line_have_no_second_component() -> None:
    with pytest.raises(ValueError, match="designs on one line, 3 in all"):
        principal_directions(torch.tensor([[1.0, 1.0], [1.5, 1.5], [2.0, 2.0]]))


def test_the_own_design_changes_nothing_and_the_simulator_agrees_with_itself(rows: TensorDict) -> None:
    row, perfect = rows[30, 1], Perfect()
    own = row["design"].unsqueeze(0)
    assert not predicted_change(perfect, row, own).any()
    assert not true_change(perfect.simulator, perfect, row, own)[0].any()
    tried = torch.tensor([[1.0, 1.0, 1.0, 1.0], [1.5, 0.6, 0.9, 2.0], [1.2, 1.9, 0.7, 0.6]])
    variance = torch.full((11,), 2.0)
    found = design_space({"perfect": perfect}, perfect.simulator, rows[[0, 30], 1], tried, variance, BOUNDS, side=5)
    assert {point["state"] for point in found} == {1, 2}
    assert sum(point["point"] == "tried" for point in found) == 2 * 3
    for point in found:
        assert point["change/perfect"] == pytest.approx(point["change/simulator"], rel=1e-4, abs=1e-8)
        assert point["normalised/simulator"] == pytest.approx(point["change/simulator"] / 11 / 2, rel=1e-4, abs=1e-8)
    grid = [point for point in found if point["point"] == "grid"]
    directions, _ = principal_directions(tried)
    for point in grid[:3]:
        design = rows[0, 1]["design"] + torch.tensor([point["pc_1"], point["pc_2"]]) @ directions
        assert [point[f"xi_{name}"] for name in ("torso", "thigh", "shank", "foot")] == pytest.approx(
            design.tolist(), abs=1e-6
        )
        state, own = rows[0, 1], rows[0, 1]["design"]
        change = by_hand(state["observation"], state["action"], design)
        change = change - by_hand(state["observation"], state["action"], own)
        assert point["change/simulator"] == pytest.approx(float(change.square().sum()), rel=1e-3, abs=1e-6)


def test_states_whose_plane_is_a_point_are_passed_over_and_the_others_stay_as_they_were_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = probe(HopperMorph, TINY, tmp_path, every=2, rows=4)
    list(measured)
    order = torch.randperm(20, generator=torch.Generator().manual_seed(TINY.seed)).tolist()
    corner, centre = torch.full((4,), 2.0), torch.full((4,), 1.25)
    designs = [*(centre + 0.75 * torch.tensor([[1.0, -1, 0, 0], [-1.0, 1, 0, 0], [0, 0, 1.0, -1], [0, 0, -1.0, 1]]))]
    designs.insert(order[1] // 4, corner)  # of four states each; the second one that is drawn is the corner's
    measured.seen = [measured.seen[0].clone() for _ in designs]
    for rows, design in zip(measured.seen, designs):
        rows["design"][:] = design
    looked_into = []

    def noted(models: dict, simulator: object, rows: TensorDict, *args: object, **kwargs: int) -> list[dict]:
        looked_into.append(rows)
        return [{"state": 1}]

    monkeypatch.setattr("coim.experiments.model_error.run.design_space", noted)
    write_design_space(measured, HopperMorph, tmp_path)
    shown = [i for i in order if designs[i // 4] is not corner]
    assert shown[:3] != order[:3]
    assert (looked_into[0] == joined(measured.seen)[shown[:3], 0]).all()
    monkeypatch.setattr("coim.experiments.model_error.design_space.AREA", 9.0)
    assert "leaves the bounds right beside every design tried" in write_design_space(measured, HopperMorph, tmp_path)
