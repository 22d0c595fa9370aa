"""The particle swarm: that it is pyswarms', what it finds, and what it leaves alone."""

from __future__ import annotations

import logging.config
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from torch import Tensor
from torchrl.data import Bounded

from coim.designs import ParticleSwarm

SPEC = Bounded(low=0.8, high=2.0, shape=(6,), dtype=torch.float32)


def bowl(designs: Tensor) -> Tensor:
    """Best at 1.3 in every entry, where it is 0."""
    return -(designs - 1.3).square().sum(-1)


def test_the_swarm_finds_the_top_of_a_bowl() -> None:
    design, value = ParticleSwarm(SPEC, num_particles=100, num_iterations=100, seed=0).maximise(bowl)
    assert design.dtype == torch.float32
    assert design.tolist() == pytest.approx([1.3] * 6, abs=0.02)
    assert value == bowl(design).item()


def test_the_swarm_finds_an_optimum_on_the_boundary() -> None:
    design, value = ParticleSwarm(SPEC, num_particles=100, num_iterations=100, seed=0).maximise(lambda x: x.sum(-1))
    assert torch.equal(design, SPEC.space.high)
    assert value == 12.0


def test_periodic_bounds_keep_the_swarm_off_the_boundary() -> None:
    swarm = ParticleSwarm(SPEC, num_particles=100, num_iterations=100, bounds="periodic", seed=0)
    assert 10.0 < swarm.maximise(lambda x: x.sum(-1))[1] < 11.9


def test_all_particles_are_evaluated_at_once_and_inside_the_bounds() -> None:
    shapes = []

    def fitness(designs: Tensor) -> Tensor:
        assert SPEC.is_in(designs)
        assert not torch.is_grad_enabled()
        shapes.append(designs.shape)
        return designs.sum(-1)

    design, _ = ParticleSwarm(SPEC, num_particles=70, num_iterations=25, seed=0).maximise(fitness)
    assert shapes == [(70, 6)] * 25
    assert SPEC.is_in(design)


@pytest.mark.parametrize("bounds", ["nearest", "periodic"])
def test_the_swarm_is_that_of_pyswarms(
    bounds: Literal["nearest", "periodic"], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # for pyswarms' report.log
    monkeypatch.setattr(logging.config, "dictConfig", lambda config: None)
    from pyswarms.single import GlobalBestPSO

    design, value = ParticleSwarm(SPEC, num_particles=30, num_iterations=20, bounds=bounds, seed=5).maximise(bowl)
    outside = np.random.get_state()  # noqa: NPY002
    limits = (SPEC.space.low.double().numpy(), SPEC.space.high.double().numpy())
    theirs = GlobalBestPSO(30, 6, {"c1": 0.5, "c2": 0.3, "w": 0.9}, bounds=limits, bh_strategy=bounds)
    np.random.seed(5)  # noqa: NPY002
    theirs.reset()  # its constructor draws a first swarm
    cost, place = theirs.optimize(lambda x: -bowl(torch.as_tensor(x).float()).numpy(), 20, verbose=False)
    np.random.set_state(outside)  # noqa: NPY002
    assert value == -cost
    assert torch.equal(design, torch.as_tensor(place).float())


def test_the_swarm_leaves_numpy_logging_and_the_working_directory_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    np.random.seed(0)  # noqa: NPY002
    handlers, level = list(logging.root.handlers), logging.root.level
    seen = []

    def fitness(designs: Tensor) -> Tensor:
        seen.append(np.random.get_state()[2])  # noqa: NPY002
        return bowl(designs)

    place = np.random.get_state()[2]  # noqa: NPY002
    ParticleSwarm(SPEC, num_particles=10, num_iterations=5).maximise(fitness)
    assert seen == [place] * 5
    assert np.random.rand() == np.random.RandomState(0).rand()  # noqa: NPY002
    assert (list(logging.root.handlers), logging.root.level) == (handlers, level)
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr() == ("", "")


def test_swarms_in_threads_find_what_each_finds_alone_and_give_numpy_and_logging_back() -> None:
    def found(seed: int) -> float:
        return ParticleSwarm(SPEC, num_particles=10, num_iterations=100, seed=seed).maximise(bowl)[1]

    alone, configure = [found(seed) for seed in range(4)], logging.config.dictConfig
    state, often = np.random.get_state()[1].copy(), sys.getswitchinterval()  # noqa: NPY002
    sys.setswitchinterval(1e-6)  # s; threads take turns within a move
    try:
        with ThreadPoolExecutor(4) as threads:
            together = list(threads.map(found, range(4)))
    finally:
        sys.setswitchinterval(often)
    assert together == alone
    assert np.array_equal(np.random.get_state()[1], state)  # noqa: NPY002
    assert logging.config.dictConfig is configure


def test_numpy_is_given_back_when_the_fitness_fails() -> None:
    before = np.random.get_state()[1].copy()  # noqa: NPY002

    def fitness(designs: Tensor) -> Tensor:
        raise KeyError("no such critic")

    with pytest.raises(KeyError, match="no such critic"):
        ParticleSwarm(SPEC, num_particles=10, num_iterations=5).maximise(fitness)
    assert np.array_equal(np.random.get_state()[1], before)  # noqa: NPY002


def test_searches_go_on_in_their_own_random_numbers_and_a_checkpoint_goes_on_too(tmp_path: Path) -> None:
    def search(seed: int) -> ParticleSwarm:
        return ParticleSwarm(SPEC, num_particles=10, num_iterations=5, seed=seed)

    first, second = search(3), search(3)
    assert first.maximise(bowl)[1] == second.maximise(bowl)[1]
    torch.save(first.state_dict(), tmp_path / "swarm.pt")
    value = first.maximise(bowl)[1]
    assert value != search(3).maximise(bowl)[1]
    resumed = search(4)
    resumed.load_state_dict(torch.load(tmp_path / "swarm.pt", weights_only=True))
    assert resumed.maximise(bowl)[1] == value


def test_a_checkpoint_may_have_been_loaded_onto_another_device() -> None:
    class Elsewhere(torch.Tensor):
        """Stands in for a tensor on a GPU, which numpy cannot read."""

        def cpu(self) -> Tensor:
            return self.as_subclass(Tensor)

        def numpy(self) -> np.ndarray:
            raise TypeError("can't convert cuda:0 device type tensor to numpy")

    saved, resumed = (ParticleSwarm(SPEC, num_particles=10, num_iterations=5, seed=seed) for seed in (3, 4))
    state = saved.state_dict()
    resumed.load_state_dict(state | {"key": state["key"].as_subclass(Elsewhere)})
    assert resumed.maximise(bowl)[1] == saved.maximise(bowl)[1]


@pytest.mark.parametrize("broken", [float("nan"), float("inf")])
def test_a_fitness_that_is_not_finite_is_named(broken: float) -> None:
    def fitness(designs: Tensor) -> Tensor:
        return torch.where(torch.arange(len(designs)) == 7, broken, bowl(designs))

    with pytest.raises(ValueError, match=rf"{broken} for the design \[.*1 of 10 designs"):
        ParticleSwarm(SPEC, num_particles=10, num_iterations=5).maximise(fitness)


def test_a_fitness_of_the_wrong_shape_is_named() -> None:
    with pytest.raises(ValueError, match=r"shape \[10, 6\], \[10\] is needed"):
        ParticleSwarm(SPEC, num_particles=10, num_iterations=5).maximise(lambda designs: designs)


def test_an_unknown_option_is_refused() -> None:
    with pytest.raises(ValueError, match="bounds='mirror' is an unknown option"):
        ParticleSwarm(SPEC, bounds="mirror")  # type: ignore[arg-type]


def test_a_swarm_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        ParticleSwarm(SPEC, num_particles=0)


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_a_seed_that_numpy_does_not_take_is_refused(seed: int) -> None:
    with pytest.raises(ValueError, match=rf"seed={seed} is outside 0 \.\. 4294967295"):
        ParticleSwarm(SPEC, seed=seed)
    ParticleSwarm(SPEC, seed=seed % 2**32)


@pytest.mark.parametrize("bounds", ["nearest", "periodic"])
def test_an_entry_may_be_held_fixed(bounds: str) -> None:
    spec = Bounded(low=torch.tensor([0.8, 1.2]), high=torch.tensor([2.0, 1.2]), shape=(2,), dtype=torch.float32)
    search = ParticleSwarm(spec, num_particles=20, num_iterations=40, bounds=bounds, seed=0)
    found, _ = search.maximise(lambda designs: -(designs - 1.5).square().sum(-1))
    assert found.tolist() == pytest.approx([1.5, 1.2], abs=0.02)
