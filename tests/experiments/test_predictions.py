"""Predicted returns against achieved ones, and what a search was worth, by numbers that a hand can check."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest

from coim.experiments.predictions import Coverage, coverage, difference, foretold, mean_of_runs, worth_of_search

NAN = math.nan


def test_a_best_return_counts_where_it_lies_within_1_645_deviations() -> None:
    rows = pd.DataFrame(
        {"expected": [0.0, 0.0, 0.0, NAN, 0.0], "deviation": [10.0] * 5, "best_return": [16.4, -16.4, 16.5, 0.0, NAN]}
    )
    assert coverage(rows) == Coverage(inside=2, total=3)
    assert len(foretold(rows)) == 3
    assert math.isnan(coverage(rows[:0]).share)


def test_ninety_per_cent_of_a_normal_distribution_lie_within() -> None:
    values = np.random.default_rng(0).normal(3.0, 2.0, 20_000)
    rows = pd.DataFrame({"expected": 3.0, "deviation": 2.0, "best_return": values})
    assert coverage(rows).share == pytest.approx(0.9, abs=0.006)


def test_twenty_right_intervals_hold_15_to_20_returns() -> None:
    assert Coverage(18, 20).by_chance == (15, 20)


def test_the_search_is_worth_the_difference_of_the_two_kinds() -> None:
    kinds = ["first", "optimised", "random", "optimised", "random"]
    rows = pd.DataFrame({"kind": kinds, "best_return": [1e6, 3.0, 1.0, 5.0, 3.0]})
    found = worth_of_search(rows)
    assert found.value == 2.0
    assert found.high == pytest.approx(2.0 + 4.3027 * math.sqrt(2.0), abs=1e-3)  # t of 2 degrees of freedom
    assert math.isnan(worth_of_search(rows[:3]).low)
    assert math.isnan(worth_of_search(rows[:1]).value)


def test_of_one_run_or_without_spread_there_is_no_interval() -> None:
    assert mean_of_runs([2.0]).value == 2.0
    assert math.isnan(mean_of_runs([2.0]).low)
    assert math.isnan(mean_of_runs([]).value)
    assert math.isnan(difference([2.0, 2.0], [1.0, 1.0]).low)
    assert math.isfinite(difference([2.0, 2.0], [1.0, 1.5]).low)
