"""Gradient ascent over designs: what it finds, where it looks, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded

from coim.designs import GradientSearch, ParticleSwarm
from coim.models import make_policy, make_qvalue
from coim.objectives import DesignValue

SPEC = Bounded(low=0.8, high=2.0, shape=(6,), dtype=torch.float32)


def bowl(designs: Tensor) -> Tensor:
    """Best at 1.3 in every entry, where it is 0."""
    return -(designs - 1.3).square().sum(-1)


def peaks(designs: Tensor) -> Tensor:
    """A wide peak of height 1 at 1.0 in every entry, and a narrower one of height 2 at 1.8."""
    wide = (-(designs - 1.0).square().sum(-1) / 0.5).exp()
    return wide + 2 * (-(designs - 1.8).square().sum(-1) / 0.2).exp()


def test_it_finds_the_top_of_a_bowl() -> None:
    design, value = GradientSearch(SPEC, seed=0).maximise(bowl)
    assert design.dtype == torch.float32
    assert design.tolist() == pytest.approx([1.3] * 6, abs=0.02)
    assert value == pytest.approx(bowl(design).item(), abs=1e-9)


def test_it_finds_an_optimum_on_the_bounds() -> None:
    slope = torch.tensor([1.0, -1.0, 0.01, -0.01, 10.0, -10.0])
    design, _ = GradientSearch(SPEC, seed=0).maximise(lambda x: x @ slope)
    assert torch.equal(design, torch.where(slope > 0, SPEC.space.high, SPEC.space.low))


def test_entries_of_unequal_range_get_equal_steps() -> None:
    spec = Bounded(low=torch.tensor([0.0, -1000.0]), high=torch.tensor([0.01, 1000.0]))
    best = torch.tensor([0.007, 300.0])
    size = spec.space.high - spec.space.low
    design, _ = GradientSearch(spec, seed=0).maximise(lambda x: -((x - best) / size).square().sum(-1))
    assert ((design - best) / size).tolist() == pytest.approx([0.0, 0.0], abs=0.01)


def test_many_starts_find_the_higher_of_two_peaks() -> None:
    for seed in range(3):
        design, value = GradientSearch(SPEC, seed=seed).maximise(peaks)
        assert design.tolist() == pytest.approx([1.8] * 6, abs=0.02)
        assert value > 1.99


def test_the_best_design_of_all_steps_is_returned() -> None:
    seen: list[Tensor] = []

    def fitness(designs: Tensor) -> Tensor:
        seen.append(designs.detach().clone())
        return (20 * designs).sin().sum(-1)  # steps of this length jump from peak to peak

    design, value = GradientSearch(SPEC, num_starts=8, num_steps=10, lr=0.5, seed=0).maximise(fitness)
    tried = torch.cat(seen)
    values = (20 * tried).sin().sum(-1)
    assert value == pytest.approx(values.max().item(), abs=1e-6)
    assert torch.equal(design, tried[values.argmax()])


def test_all_starts_are_evaluated_at_once_and_inside_the_bounds() -> None:
    shapes = []

    def fitness(designs: Tensor) -> Tensor:
        assert SPEC.is_in(designs)
        shapes.append(designs.shape)
        return designs.sum(-1)

    GradientSearch(SPEC, num_starts=7, num_steps=25, lr=1.0, seed=0).maximise(fitness)
    assert shapes == [(7, 6)] * 25


def test_searches_go_on_in_their_own_random_numbers_and_a_checkpoint_goes_on_too(tmp_path: Path) -> None:
    def search(seed: int) -> GradientSearch:
        return GradientSearch(SPEC, num_starts=2, num_steps=3, seed=seed)

    first, second = search(3), search(3)
    assert first.maximise(bowl)[1] == second.maximise(bowl)[1]
    torch.save(first.state_dict(), tmp_path / "search.pt")
    value = first.maximise(bowl)[1]
    assert value != search(3).maximise(bowl)[1]
    resumed = search(4)
    resumed.load_state_dict(torch.load(tmp_path / "search.pt", weights_only=True))
    assert resumed.maximise(bowl)[1] == value


def test_the_global_random_numbers_and_the_gradient_mode_are_left_alone() -> None:
    torch_state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    with torch.no_grad():
        GradientSearch(SPEC, num_starts=4, num_steps=3).maximise(bowl)
        assert not torch.is_grad_enabled()
    assert torch.equal(torch.get_rng_state(), torch_state)
    assert np.array_equal(np.random.get_state()[1], numpy_state)  # noqa: NPY002


def test_it_agrees_with_the_swarm_on_the_fitness_of_a_network_and_leaves_the_network_alone(toy_env) -> None:
    torch.manual_seed(0)
    policy, qvalue = make_policy(toy_env, num_cells=(32, 32)), make_qvalue(toy_env, num_cells=(32, 32))
    starts = TensorDict({"observation": torch.randn(9, 3)}, [9])
    fitness = DesignValue(policy, qvalue, starts)
    swarm = ParticleSwarm(toy_env.design_spec, num_particles=50, num_iterations=50, seed=0).maximise(fitness)[1]
    design, value = GradientSearch(toy_env.design_spec, seed=0).maximise(fitness)
    assert value == pytest.approx(swarm, abs=1e-4)
    assert fitness(design.unsqueeze(0)).item() == pytest.approx(value, abs=1e-5)
    assert all(p.grad is None for p in (*policy.parameters(), *qvalue.parameters()))


@pytest.mark.parametrize(
    "fitness", [lambda x: bowl(x.detach()), lambda x: torch.ones(len(x), requires_grad=True)], ids=["detached", "apart"]
)
def test_a_fitness_without_gradient_is_named(fitness) -> None:
    with pytest.raises(ValueError, match=r"not differentiable in the designs .* ParticleSwarm does not"):
        GradientSearch(SPEC).maximise(fitness)


def test_values_and_gradients_that_are_not_finite_are_named() -> None:
    def broken_value(designs: Tensor) -> Tensor:
        return bowl(designs) + torch.where(torch.arange(len(designs)) == 7, torch.nan, 0.0)

    with pytest.raises(ValueError, match=r"nan for the design \[.*1 of 64 designs"):
        GradientSearch(SPEC).maximise(broken_value)
    with pytest.raises(ValueError, match=r"the fitness returned a ndarray; return a tensor \[P\], as by torch"):
        GradientSearch(SPEC).maximise(lambda designs: designs.detach().numpy().sum(-1))
    with pytest.raises(ValueError, match=r"gradient of the fitness is not finite at \[.* 64 designs in all"):
        GradientSearch(SPEC).maximise(lambda x: (x - x.detach()).sqrt().sum(-1))


def test_a_fitness_of_the_wrong_shape_is_named() -> None:
    with pytest.raises(ValueError, match=r"shape \[64, 6\], \[64\] is needed"):
        GradientSearch(SPEC).maximise(lambda designs: designs)


@pytest.mark.parametrize(
    ("option", "complaint"), [("num_starts", "0 starts"), ("num_steps", "0 steps"), ("lr", "lr is 0")]
)
def test_bad_options_are_refused(option: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        GradientSearch(SPEC, **{option: 0})


def test_bounds_of_something_else_are_refused() -> None:
    with pytest.raises(ValueError, match=r"pass env\.design_spec"):
        GradientSearch(SPEC.expand(3, 6))


def test_inference_mode_is_named_and_not_the_fitness() -> None:
    search = GradientSearch(Bounded(low=0.0, high=1.0, shape=(2,)), seed=0)
    with torch.inference_mode(), pytest.raises(RuntimeError, match=r"which torch.inference_mode\(\) forbids"):
        search.maximise(lambda designs: designs.sum(-1))
