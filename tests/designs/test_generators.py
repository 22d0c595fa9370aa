"""Generators of designs: their distributions, their random numbers, what they refuse."""

from __future__ import annotations

import pytest
import torch
from torchrl.data import Bounded

from coim.designs import KnownDesigns, NoisyDesigns, RandomDesigns

LOW, HIGH = 0.8, 2.0
SPEC = Bounded(low=LOW, high=HIGH, shape=(6,), dtype=torch.float32)


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_known_designs_are_the_designs_themselves() -> None:
    design = torch.rand(4, 3, 6)
    assert torch.equal(KnownDesigns()(design, rng=rng()), design)


def test_noise_has_the_standard_deviation_that_was_asked_for() -> None:
    middle = torch.full((20_000, 6), 1.4)
    noise = NoisyDesigns(SPEC, sigma=0.1)(middle, rng=rng()) - middle
    assert noise.std().item() == pytest.approx(0.1, rel=0.01)
    assert noise.mean().item() == pytest.approx(0.0, abs=1e-3)


def test_noisy_designs_are_clipped_to_the_bounds() -> None:
    corner = torch.tensor([LOW, HIGH]).repeat(1000, 3)
    noisy = NoisyDesigns(SPEC, sigma=0.5)(corner, rng=rng())
    assert SPEC.is_in(noisy)
    assert 0.4 < (noisy == corner).float().mean().item() < 0.6  # half of the draws leave the corner on the outer side


def test_random_designs_forget_the_design_and_fill_the_space_evenly() -> None:
    random = RandomDesigns(SPEC)(torch.full((20_000, 6), 5.0), rng=rng())
    assert SPEC.is_in(random)
    assert random.mean().item() == pytest.approx((LOW + HIGH) / 2, abs=0.01)
    assert random.std().item() == pytest.approx((HIGH - LOW) / 12**0.5, rel=0.01)


@pytest.mark.parametrize("generator", [NoisyDesigns(SPEC), RandomDesigns(SPEC)])
def test_a_generator_draws_from_its_rng_and_from_nothing_else(generator: NoisyDesigns | RandomDesigns) -> None:
    design = torch.full((5, 3, 6), 1.4)
    before = torch.get_rng_state()
    once, again, other = generator(design, rng=rng(1)), generator(design, rng=rng(1)), generator(design, rng=rng(2))
    assert once.shape == design.shape
    assert torch.equal(once, again)
    assert not torch.equal(once, other)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("generator", [NoisyDesigns(SPEC), RandomDesigns(SPEC)])
def test_rows_of_a_batch_get_draws_of_their_own(generator: NoisyDesigns | RandomDesigns) -> None:
    assert generator(torch.full((64, 6), 1.4), rng=rng()).unique(dim=0).shape == (64, 6)


def test_bad_generators_say_what_is_wrong() -> None:
    with pytest.raises(ValueError, match=r"sigma is -1"):
        NoisyDesigns(SPEC, sigma=-1)
    with pytest.raises(ValueError, match=r"does not have the 6 entries"):
        RandomDesigns(SPEC)(torch.ones(3, 4))
    with pytest.raises(ValueError, match=r"env\.design_spec"):
        RandomDesigns(SPEC.expand(3, 6))
