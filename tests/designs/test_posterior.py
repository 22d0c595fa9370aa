"""The posterior over designs: what it learns from returns, how sure it is, when it listens to a critic."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable

import pytest
import torch
from noisy_bowl import HIGH, LOW, SPEC, TOP, bowl, built, noise, returns_of
from torch import Tensor
from torchrl.data import Bounded

from coim.designs import DesignPosterior, GradientSearch, ParticleSwarm, TrustRegion
from coim.designs.posterior import _fitted

SPEC4 = Bounded(low=LOW, high=HIGH, shape=(4,), dtype=torch.float32)


@pytest.mark.parametrize("search", [GradientSearch(SPEC, seed=0), ParticleSwarm(SPEC, num_particles=50, seed=0)])
def test_both_searches_find_the_top_of_a_quadratic_from_noisy_returns(search: GradientSearch | ParticleSwarm) -> None:
    designs = built(60)
    posterior = DesignPosterior(SPEC, designs, returns_of(designs), optimism=0.0)
    design, value = search.maximise(posterior)
    assert design.tolist() == pytest.approx(TOP.tolist(), abs=0.1)
    assert value == pytest.approx(1000, abs=60)


def test_means_follow_the_surface_that_the_returns_were_drawn_from() -> None:
    designs, others = built(60), built(200, seed=2)
    mean, _ = DesignPosterior(SPEC, designs, returns_of(designs)).predict(others)
    truth = 1000 + 400 * bowl(others)
    assert (mean - truth).square().mean().sqrt() < 0.35 * truth.std()


def test_the_fit_is_the_textbook_formula_at_its_own_parameters() -> None:
    designs, candidates = built(9).double(), built(5, seed=3).double()
    returns = returns_of(designs)
    posterior = DesignPosterior(SPEC, designs, returns, prior=bowl, optimism=2.0)
    kernel = posterior.model.covar_module
    length, signal = kernel.base_kernel.lengthscale.item(), kernel.outputscale.item()

    def covariance(a: Tensor, b: Tensor) -> Tensor:
        distance = torch.cdist(a, b) / (HIGH - LOW)
        return signal * (-0.5 * (distance / length) ** 2).exp() * returns.std() ** 2

    def mean(values: Tensor, order: Tensor) -> Tensor:
        a = returns.mean() + posterior.model.mean_module.intercept * returns.std()
        return a + posterior.slope * (values - bowl(designs).mean()) + posterior.trend * order

    noisy = covariance(designs, designs) + posterior.noise**2 * torch.eye(9, dtype=torch.float64)
    weights = torch.linalg.solve(noisy, covariance(designs, candidates)).T
    order = torch.arange(10, dtype=torch.float64)
    expected = mean(bowl(candidates), order[9]) + weights @ (returns - mean(bowl(designs), order[:9]))
    variance = signal * returns.std() ** 2 - (weights * covariance(candidates, designs)).sum(-1)
    found, deviation = posterior.predict(candidates)
    assert torch.allclose(found, expected, rtol=1e-9)
    assert torch.allclose(deviation, (variance + posterior.noise**2).sqrt(), rtol=1e-9)
    assert torch.allclose(posterior(candidates), expected + 2 * variance.sqrt(), rtol=1e-9)


def test_the_slope_on_a_good_critic_is_positive_and_near_what_its_values_are_worth() -> None:
    designs = built(30)
    posterior = DesignPosterior(SPEC, designs, returns_of(designs), prior=lambda x: 7 + 2 * bowl(x))
    assert posterior.slope == pytest.approx(200, rel=0.3)


@pytest.mark.parametrize("critic", [lambda x: -bowl(x), lambda x: torch.full((len(x),), 3.0)])
def test_a_critic_that_says_the_opposite_or_nothing_drops_out_entirely(critic: object) -> None:
    designs, candidates = built(12), built(50, seed=3)
    posterior = DesignPosterior(SPEC, designs, returns_of(designs), prior=critic)
    assert posterior.slope == 0.0
    without = DesignPosterior(SPEC, designs, returns_of(designs))
    assert without.slope == 0.0
    assert torch.allclose(posterior(candidates), without(candidates), rtol=1e-4)


def test_returns_that_rise_whatever_the_body_are_a_trend() -> None:
    designs = built(30)
    level = DesignPosterior(SPEC, designs, returns_of(designs))
    rising = DesignPosterior(SPEC, designs, returns_of(designs) + 10 * torch.arange(30))
    assert level.trend == pytest.approx(0, abs=2.5)
    assert rising.trend == pytest.approx(10, abs=2.5)
    assert rising.predict(TOP[None])[0].item() == pytest.approx(1000 + 30 * 10, rel=0.1)


def test_the_90_percent_interval_covers_80_to_97_percent_of_new_returns() -> None:
    inside = []
    for seed in range(40):
        rng = torch.Generator().manual_seed(seed)
        top = LOW + (HIGH - LOW) * torch.rand(4, generator=rng)
        designs, others = built(15, seed, entries=4), built(20, 1000 + seed, entries=4)

        def surface(x: Tensor, top: Tensor = top) -> Tensor:
            return 1000 - 300 * (x - top).square().sum(-1)

        mean, deviation = DesignPosterior(SPEC4, designs, surface(designs) + noise(15, 400, seed)).predict(others)
        inside.append((surface(others) + noise(20, 400, 1000 + seed) - mean).abs() < 1.645 * deviation)
    assert 0.80 < torch.cat(inside).float().mean() < 0.97


def test_the_gradient_is_that_of_finite_differences() -> None:
    designs = built(10)
    posterior = DesignPosterior(SPEC, designs, returns_of(designs), prior=bowl)
    assert posterior.slope > 0
    assert torch.autograd.gradcheck(posterior, built(4, seed=5).double().requires_grad_())


def test_a_candidates_value_does_not_depend_on_the_others() -> None:
    designs, candidates = built(10), built(7, seed=5).double()
    posterior = DesignPosterior(SPEC, designs, returns_of(designs), prior=bowl)
    assert torch.allclose(posterior(candidates)[:1], posterior(candidates[:1]), rtol=1e-12)


def test_the_same_data_give_the_same_bits_and_nothing_is_drawn() -> None:
    designs, candidates = built(15), built(50, seed=3)
    torch.manual_seed(5)
    before = torch.get_rng_state()
    first = DesignPosterior(SPEC, designs, returns_of(designs), prior=bowl)(candidates)
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(6)
    assert torch.equal(first, DesignPosterior(SPEC, designs, returns_of(designs), prior=bowl)(candidates))


def test_neither_the_order_of_rows_nor_that_of_entries_matters() -> None:
    designs, candidates = built(15).double(), built(50, seed=3).double()
    posterior = DesignPosterior(SPEC, designs, returns_of(designs), prior=bowl)
    inputs, targets = posterior.model.train_inputs[0], posterior.model.train_targets
    turned = _fitted(inputs.flip(0), targets.flip(0))
    at = posterior.inputs(candidates)
    assert torch.allclose(turned.posterior(at).mean, posterior.model.posterior(at).mean, atol=1e-4)
    swapped = DesignPosterior(SPEC, designs.flip(-1), returns_of(designs), prior=lambda x: bowl(x.flip(-1)))
    assert torch.allclose(swapped(candidates.flip(-1)), posterior(candidates), rtol=1e-4)


def test_a_body_without_a_return_is_left_out_and_keeps_its_place_in_the_order() -> None:
    returns = torch.tensor([1.0, math.nan, 3.0, 2.0])
    posterior = DesignPosterior(SPEC, built(4), returns)
    assert posterior.model.train_inputs[0][:, 2].tolist() == [0.0, 0.5, 0.75]
    assert posterior.inputs(built(1))[0, 2] == 1.0


def test_dtypes_are_those_of_the_candidates_and_the_critic_is_asked_on_them() -> None:
    asked = []

    def critic(designs: Tensor) -> Tensor:
        asked.append(designs.dtype)
        return bowl(designs)

    posterior = DesignPosterior(SPEC, built(5), returns_of(built(5)), prior=critic)
    assert posterior(built(3)).dtype == torch.float32
    assert [part.dtype for part in posterior.predict(built(3))] == [torch.float32] * 2
    assert asked == [torch.float32] * 3


@pytest.mark.parametrize(
    ("designs", "returns", "arguments", "complaint"),
    [
        (built(4), torch.tensor([1.0, 2.0, math.nan, math.inf]), {}, "2 of 4 returns are finite, 3 are needed"),
        (built(4), torch.tensor([5.0, 5.0, math.nan, 5.0]), {}, "all 3 returns are 5.0"),
        (built(4), torch.ones(3), {}, r"designs \[4, 2\] and returns \[3\] do not belong together; pass \[N, 2\]"),
        (built(4, entries=3), torch.arange(4.0), {}, r"designs \[4, 3\] .* pass \[N, 2\]"),
        (built(3).fill_diagonal_(math.nan), torch.arange(3.0), {}, "design 0 has an entry that is not finite"),
        (built(3) + HIGH, torch.arange(3.0), {}, rf"design 0 has .* as its entry 0, .* in \[{LOW:g}, {HIGH:g}\]; pass"),
        (built(3) * 0, torch.arange(3.0), {}, "design 0 has 0 as its entry 0"),
        (built(3), torch.arange(3.0), {"optimism": -1.0}, "optimism is -1.0"),
        (built(3), torch.arange(3.0), {"prior": lambda x: x[:, 0] * math.nan}, "the fitness is nan"),
    ],
)
def test_what_cannot_be_fitted_is_refused(
    designs: Tensor, returns: Tensor, arguments: dict[str, object], complaint: str
) -> None:
    with pytest.raises(ValueError, match=complaint):
        DesignPosterior(SPEC, designs, returns, **arguments)


def test_a_single_design_needs_a_dimension_of_its_own() -> None:
    posterior = DesignPosterior(SPEC, built(4), torch.arange(4.0))
    with pytest.raises(ValueError, match=r"designs of shape \[2\] must be \[P, 2\]; a single one is design\[None\]"):
        posterior.predict(torch.ones(2))


def test_an_entry_may_be_held_fixed() -> None:
    spec = Bounded(low=torch.tensor([LOW, 1.2]), high=torch.tensor([HIGH, 1.2]), shape=(2,), dtype=torch.float32)
    designs = built(12)
    designs[:, 1] = 1.2
    posterior = DesignPosterior(spec, designs, returns_of(designs))
    found, _ = GradientSearch(spec, seed=0).maximise(posterior)
    assert found.tolist() == pytest.approx([TOP[0].item(), 1.2], abs=0.2)
    assert all(part.isfinite().all() for part in posterior.predict(designs))
    near, _ = TrustRegion(spec, GradientSearch(spec, seed=0), reach=0.2).maximise(bowl, centre=torch.tensor([1.1, 1.2]))
    assert near.tolist() == pytest.approx([1.0, 1.2], abs=0.01)


def test_designs_that_a_transform_has_rounded_beyond_the_bounds_are_fitted() -> None:
    designs = built(6)
    designs[0, 0], designs[1, 1] = HIGH * (1 + 1e-6), LOW * (1 - 1e-6)
    assert DesignPosterior(SPEC, designs, returns_of(designs))(designs).isfinite().all()


def test_numbers_stay_on_the_cpu_under_another_default_device() -> None:
    designs = built(12)
    returns = returns_of(designs)
    for prior in (None, bowl):
        expected = DesignPosterior(SPEC, designs, returns, prior=prior).predict(designs)
        with torch.device("meta"):
            again = DesignPosterior(SPEC, designs, returns, prior=prior)
            assert all(torch.equal(one, other) for one, other in zip(expected, again.predict(designs)))


def test_the_difference_of_two_bodies_is_that_of_their_means_and_of_neighbours_surer_than_either() -> None:
    designs = built(20)
    posterior = DesignPosterior(SPEC, designs, returns_of(designs))
    bodies = built(3, seed=9)
    mean, deviation = posterior.difference(bodies, bodies + 0.05)
    assert torch.allclose(mean, posterior.predict(bodies)[0] - posterior.predict(bodies + 0.05)[0], atol=1e-3)
    own = (posterior.predict(bodies)[1] ** 2 - posterior.noise**2).sqrt()
    assert bool((deviation < own / 2).all())
    assert posterior.difference(bodies, bodies)[1].abs().max() < 1e-2


@pytest.mark.parametrize("context", [torch.no_grad, torch.inference_mode])
def test_it_is_fitted_where_the_caller_wants_no_gradients(context: type) -> None:
    """A whole run may be under `torch.no_grad`, and the first fit is hours in."""
    designs = built(12)
    outside = DesignPosterior(SPEC, designs, returns_of(designs)).predict(built(3, seed=9))
    with context():
        inside = DesignPosterior(SPEC, built(12), returns_of(built(12))).predict(built(3, seed=9))
    for found, expected in zip(inside, outside):
        torch.testing.assert_close(found, expected)


def test_a_prior_that_varies_by_rounding_alone_has_no_slope() -> None:
    designs = built(12)
    rounded = torch.tensor([1000.0, 1000.0001] * 6)
    posterior = DesignPosterior(SPEC, designs, returns_of(designs), prior=lambda asked: rounded[: len(asked)])
    assert posterior.slope == 0.0
    plain = DesignPosterior(SPEC, designs, returns_of(designs))
    assert torch.equal(posterior(designs), plain(designs))


def test_a_search_by_gradients_does_not_climb_past_a_prior_that_has_none() -> None:
    designs = built(12)

    def without_gradient(asked: Tensor) -> Tensor:
        return bowl(asked.detach())

    posterior = DesignPosterior(SPEC, designs, returns_of(designs), prior=without_gradient)
    with pytest.raises(ValueError, match=r"the prior is not differentiable in the designs .*such as ParticleSwarm"):
        GradientSearch(SPEC, seed=0).maximise(posterior)
    assert ParticleSwarm(SPEC, num_particles=9, num_iterations=3, seed=0).maximise(posterior)[1] > 0


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda posterior: pickle.loads(pickle.dumps(posterior))])
def test_a_copy_says_the_same_to_the_last_bit(copied: Callable[[DesignPosterior], DesignPosterior]) -> None:
    posterior = DesignPosterior(SPEC, built(9), returns_of(built(9)), prior=bowl)
    other, asked = copied(posterior), built(30)
    assert torch.equal(other(asked), posterior(asked))
    assert all(map(torch.equal, other.predict(asked), posterior.predict(asked)))
    assert (other.slope, other.trend, other.noise) == (posterior.slope, posterior.trend, posterior.noise)
