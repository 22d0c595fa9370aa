"""A search that stays near a body, and what no search takes as bounds or as a design."""

from __future__ import annotations

import math

import pytest
import torch
from noisy_bowl import LOW, SPEC, bowl
from torchrl.data import Bounded, Composite

from coim.designs import DesignPosterior, GradientSearch, NoisyDesigns, RandomDesigns, TrustRegion


def test_a_trust_region_holds_the_best_near_its_centre_and_ends_at_the_bounds() -> None:
    region = TrustRegion(SPEC, GradientSearch(SPEC, seed=0), reach=0.2)
    near, value = region.maximise(bowl, centre=torch.tensor([1.8, 1.5]))
    assert near.tolist() == pytest.approx([1.8 - 0.2 * 1.5, 1.6], abs=0.01)
    assert value == pytest.approx(bowl(near).item())
    at_edge, _ = region.maximise(lambda x: -x.sum(-1), centre=torch.tensor([0.6, 2.0]))
    assert at_edge.tolist() == pytest.approx([0.5, 1.7])


def test_a_trust_region_stays_where_its_search_looks() -> None:
    narrow = Bounded(low=1.0, high=1.2, shape=(2,), dtype=torch.float32)
    region = TrustRegion(SPEC, GradientSearch(narrow, seed=0), reach=0.05)
    for slope in (-1.0, 1.0):
        for centre, reached in ((1.1, 1.1 + slope * 0.075), (0.6, 1.0), (1.9, 1.2)):
            found, _ = region.maximise(lambda x, slope=slope: slope * x.sum(-1), centre=torch.full((2,), centre))
            assert found.tolist() == pytest.approx([reached] * 2)


def test_a_trust_region_refuses_a_centre_outside_and_a_reach_of_nothing() -> None:
    search = GradientSearch(SPEC, seed=0)
    with pytest.raises(ValueError, match=r"the centre \[2.5, 1.0\] is not a design"):
        TrustRegion(SPEC, search).maximise(bowl, centre=torch.tensor([2.5, 1.0]))
    with pytest.raises(ValueError, match="reach is 0"):
        TrustRegion(SPEC, search, reach=0)


def test_designs_of_whole_numbers_are_refused() -> None:
    whole = torch.tensor([[1, 1], [2, 1], [1, 2], [2, 2]])
    with pytest.raises(ValueError, match=r"a design is torch\.int64, .*pass design.float\(\)"):
        DesignPosterior(SPEC, whole, torch.arange(4.0))
    for asked in (RandomDesigns(SPEC), NoisyDesigns(SPEC)):
        with pytest.raises(ValueError, match=r"a design is torch\.int64"):
            asked(whole)
    region = TrustRegion(SPEC, GradientSearch(SPEC, seed=0))
    with pytest.raises(ValueError, match=r"a design is torch\.int64"):
        region.maximise(bowl, centre=whole[0])


def test_a_trust_region_takes_the_corner_of_its_spec_in_any_precision() -> None:
    region = TrustRegion(SPEC, GradientSearch(SPEC, seed=0), reach=0.5)
    corner = torch.tensor([LOW, LOW], dtype=torch.float64)
    assert region.maximise(bowl, centre=corner)[0].dtype == torch.float32


def test_bounds_that_bound_nothing_are_refused() -> None:
    for low, high in ((2.0, 1.0), (0.0, math.inf), (math.nan, 1.0)):
        with pytest.raises(ValueError, match="are no bounds of a design"):
            GradientSearch(Bounded(low=torch.tensor([low, 0.0]), high=torch.tensor([high, 1.0]), shape=(2,)))
    with pytest.raises(ValueError, match="is not the bounds of one design"):
        GradientSearch(Composite(design=SPEC))
