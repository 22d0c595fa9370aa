"""Curves and correlations of the columns of a table."""

from __future__ import annotations

import math

import pandas as pd
import pytest

from coim.experiments.frames import curves, spearman


def test_the_rank_correlation_is_spearmans_and_nan_where_it_says_nothing() -> None:
    assert spearman([1, 2, 3], [1, 10, 11]) == pytest.approx(1.0)
    assert spearman([1, 2, 3], [9, 3, 2]) == pytest.approx(-1.0)
    assert spearman([1, 2, 3, 4], [1, 2, 3, 0]) == pytest.approx(-0.2)  # 1 - 6 * 12 / (4 * 15)
    assert math.isnan(spearman([1, 2], [1, 10]))
    assert math.isnan(spearman([1, 1, 1], [1, 2, 3]))
    assert math.isnan(spearman([1, 2, 3], [4, 4, 4]))


def test_curves_are_means_over_the_runs_and_neighbours_that_have_a_number() -> None:
    rows = pd.DataFrame([{"run": k, "x": x, "y": 10.0 * k + x} for k in (0, 1) for x in range(6)])
    rows.loc[[3, 5, 11], "y"] = math.nan  # run 0 at 3, and both at 5
    found = curves(rows, "x", "y")
    assert found.x.tolist() == [0, 1, 2, 3, 4]
    assert found.mean.tolist() == [5, 6, 7, 13, 9]
    pairs = found.averaged(2)
    assert pairs.x.tolist() == [0.5, 2.5, 4]
    assert pairs.y.tolist() == [[0.5, 2, 4], [10.5, 12.5, 14]]
    assert found.averaged(1) is found
    assert curves(rows, "x", "z").x.size == 0


def test_runs_of_several_folders_are_told_apart_and_the_last_row_of_a_point_counts() -> None:
    rows = pd.DataFrame({"folder": ["a", "a", "b"], "run": [0, 0, 0], "x": [1, 1, 1], "y": [3.0, 4.0, 5.0]})
    assert curves(rows, "x", "y", runs=("folder", "run")).y.tolist() == [[4.0], [5.0]]
