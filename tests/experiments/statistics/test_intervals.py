"""Statistics with numbers that a hand can check."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from coim.experiments.statistics.intervals import FEW, holm, improvement, interval, iqm, mean, over_runs


def test_the_interquartile_mean_weighs_the_values_at_the_quartiles_in_part() -> None:
    assert iqm(np.array([7.0])) == 7
    assert iqm(np.array([1.0, 3.0])) == 2
    assert iqm(np.array([9.0, 0.0, 3.0])) == pytest.approx(0 / 6 + 3 * 4 / 6 + 9 / 6)
    assert iqm(np.array([-50.0, 1.0, 2.0, 4.0, 90.0])) == pytest.approx(0.3 * 1 + 0.4 * 2 + 0.3 * 4)


def test_of_a_multiple_of_four_it_is_the_trimmed_mean_of_scipy_along_any_axis() -> None:
    values = np.random.default_rng(1).normal(size=(8, 3))
    np.testing.assert_allclose(iqm(values, axis=0), stats.trim_mean(values, 0.25, axis=0))
    np.testing.assert_allclose(iqm(values.T), stats.trim_mean(values, 0.25, axis=0))


def test_the_interval_of_two_runs_ends_at_the_runs_and_one_run_has_none() -> None:
    low, high = interval(mean, np.array([1.0, 5.0]))
    assert (low, high) == (1, 5)  # both ends are a quarter of all resamples
    assert np.isnan(interval(mean, np.array([1.0]))).all()


def test_the_interval_of_many_runs_is_that_of_the_normal_distribution_and_repeats() -> None:
    values = np.random.default_rng(0).normal(size=400)
    low, high = interval(mean, values)
    assert low == pytest.approx(values.mean() - 1.96 / 20, abs=0.015)
    assert high == pytest.approx(values.mean() + 1.96 / 20, abs=0.015)
    assert interval(mean, values) == (low, high)


def test_a_stratum_is_drawn_by_itself() -> None:
    # Within each stratum all runs are alike: nothing can vary, however different the strata are.
    low, high = interval(improvement, *(np.full(3, value) for value in (5.0, 4.0, 100.0, 200.0)))
    assert (low, high) == (0.5, 0.5)


def test_a_curve_uses_at_each_point_the_runs_that_have_one() -> None:
    values = np.array([[1.0, 2.0, np.nan], [3.0, 4.0, np.nan], [8.0, np.nan, np.nan]])
    value, low, high, count = over_runs(values, mean)
    assert value[:2].tolist() == [4, 3]
    assert count.tolist() == [3, 2, 0]
    assert (low[1], high[1]) == (2, 4)
    assert np.isnan([value[2], low[2], high[2]]).all()


def test_improvement_is_mann_whitneys_u_over_the_pairs() -> None:
    x, y = np.array([3.0, 1.0, 4.0, 1.0, 5.0]), np.array([2.0, 7.0, 1.0])
    assert improvement(x, y) == pytest.approx(stats.mannwhitneyu(x, y).statistic / 15)
    assert improvement(x, y) == pytest.approx(1 - improvement(y, x))
    assert improvement(x, x) == 0.5


@pytest.mark.parametrize(("runs", "of_the_mean", "of_the_iqm"), [(3, 0.76, 0.76), (5, 0.84, 0.91), (10, 0.90, 0.94)])
def test_intervals_of_few_runs_hold_the_truth_as_often_as_is_said(
    runs: int, of_the_mean: float, of_the_iqm: float
) -> None:
    studies = np.random.default_rng(0).normal(size=(runs, 1000))  # a column each
    for statistic, expected in ((mean, of_the_mean), (iqm, of_the_iqm)):
        low, high = interval(statistic, studies)
        assert np.mean((low <= 0) & (high >= 0)) == pytest.approx(expected, abs=0.03)  # 2.5 standard errors
    assert f"{of_the_mean:.0%}" in FEW
    assert f"{of_the_iqm:.0%}" in FEW


def test_strata_count_alike_however_many_runs_they_have() -> None:
    always, never = (np.full(9, 1.0), np.zeros(9)), (np.zeros(2), np.full(2, 1.0))
    assert improvement(*always, *never) == 0.5


def test_holm_corrects_as_in_a_hand_example() -> None:
    # Four tests in order .005, .01, .03, .04: times 4, 3, 2, 1, and never below the one before.
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.7]) == [1, 1]


def test_a_test_that_could_not_be_made_does_not_count_in_holm() -> None:
    corrected = holm([float("nan"), 0.01, 0.02])
    assert np.isnan(corrected[0])
    assert corrected[1:] == pytest.approx([0.02, 0.02])
