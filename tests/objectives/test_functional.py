"""Closed forms, with numbers that a hand can check."""

import math

import pytest
import torch
from torch.distributions import Normal
from torchrl.modules import TanhNormal

from coim.objectives import functional


def double(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def test_the_soft_value_is_the_lower_critic_plus_entropy():
    q = double(3.0, 5.0, 7.0, 2.0).reshape(2, 2)
    assert functional.soft_value(q, log_prob=double(1.0, -2.0), alpha=0.5).tolist() == [2.5, 3.0]


def test_a_terminated_row_does_not_bootstrap():
    target = functional.bellman_target(
        reward=torch.ones(2), terminated=torch.tensor([False, True]), value=torch.full((2,), 10.0), gamma=0.5
    )
    assert target.tolist() == [6.0, 1.0]


def test_a_terminated_row_ignores_even_a_broken_value():
    target = functional.bellman_target(double(1.0), torch.tensor([True]), double(math.nan), gamma=0.5)
    assert target.tolist() == [1.0]


def test_the_qvalue_loss_has_the_printed_one_half_and_sums_over_critics():
    q = double(3.0, 6.0, 2.0).reshape(1, 3)
    assert functional.qvalue_loss(q, target=double(2.0)).tolist() == [8.5]  # (1 + 16 + 0) / 2


def test_the_policy_loss_is_the_cost_of_certainty_minus_the_lower_critic():
    q = double(6.0, 3.0).reshape(1, 2)
    assert functional.policy_loss(q, log_prob=double(4.0), alpha=0.25).tolist() == [-2.0]


def test_the_action_at_zero_noise_is_the_tanh_of_loc():
    action, log_prob = functional.tanh_normal(double(0.0), double(1.0), double(0.0))
    assert action.tolist() == [0.0]
    assert log_prob.item() == pytest.approx(-math.log(2 * math.pi) / 2)  # the slope of tanh at 0 is 1


def test_tanh_normal_is_torchrls():
    loc, log_scale = torch.randn(2, 20, 4, dtype=torch.float64).unbind(0)
    torch.manual_seed(0)
    expected_action, expected = TanhNormal(loc, log_scale.exp()).rsample_and_log_prob()
    torch.manual_seed(0)
    action, log_prob = functional.tanh_normal(loc, log_scale.exp(), torch.randn(20, 4, dtype=torch.float64))
    torch.testing.assert_close(action, expected_action, rtol=1e-14, atol=0)
    torch.testing.assert_close(log_prob, expected, rtol=1e-13, atol=1e-13)


def test_the_density_is_exact_where_the_tanh_saturates():
    _, log_prob = functional.tanh_normal(double(30.0), double(1.0), double(0.0))
    expected = -math.log(2 * math.pi) / 2 - 2 * (math.log(2) - 30)  # log(1 - tanh(u)^2) -> 2 (log 2 - u)
    assert log_prob.item() == pytest.approx(expected, abs=1e-12)


def test_batch_mixing_counts_every_row_once():
    imagined = torch.tensor([False, False, False, True]).unsqueeze(1)
    assert functional.mixing_weights(imagined, "batch").flatten().tolist() == [0.25] * 4


def test_sum_mixing_adds_two_means_run_by_run():
    imagined = torch.tensor([[False, True], [False, True], [False, False], [True, False]])
    weights = functional.mixing_weights(imagined, "sum", dtype=torch.float64)
    third = 1 / 3
    assert weights.tolist() == [[third, 0.5], [third, 0.5], [third, 0.5], [1.0, 0.5]]


@pytest.mark.parametrize("imagined", [True, False])
def test_sum_mixing_of_one_kind_is_its_mean(imagined):
    assert functional.mixing_weights(torch.full((4, 1), imagined), "sum").flatten().tolist() == [0.25] * 4


def test_importance_is_shared_out_within_each_mean():
    imagined = torch.tensor([[False], [False], [True], [True]])
    importance = torch.tensor([[1.0], [3.0], [2.0], [2.0]])
    batch, summed = (functional.mixing_weights(imagined, mix, importance=importance) for mix in ("batch", "sum"))
    assert batch.flatten().tolist() == [0.125, 0.375, 0.25, 0.25]
    assert summed.flatten().tolist() == [0.25, 0.75, 0.5, 0.5]


def test_a_kind_whose_rows_all_weigh_nothing_gets_nothing():
    imagined = torch.tensor([[True], [False]])
    importance = torch.tensor([[0.0], [2.0]])
    assert functional.mixing_weights(imagined, "sum", importance=importance).flatten().tolist() == [0, 1]


def test_the_nll_is_eq_6_as_printed():
    nll = functional.gaussian_nll(double(1.0, 2.0), log_var=double(0.0, math.log(4.0)), target=double(3.0, 6.0))
    assert nll.item() == pytest.approx(4 + 16 / 4 + math.log(4))


def test_the_nll_is_twice_the_negative_log_density_without_its_constant():
    mean, log_var, target = torch.randn(3, 10, 4, dtype=torch.float64).unbind(0)
    density = Normal(mean, (log_var / 2).exp()).log_prob(target).sum(-1)
    torch.testing.assert_close(
        functional.gaussian_nll(mean, log_var, target), -2 * density - 4 * math.log(2 * math.pi), rtol=1e-13, atol=1e-13
    )


def test_the_value_of_a_design_is_the_mean_of_the_lower_critics():
    q = double(1.0, 5.0, 3.0, 2.0).reshape(1, 2, 2)
    assert functional.design_value(q).tolist() == [1.5]  # (1 + 2) / 2
