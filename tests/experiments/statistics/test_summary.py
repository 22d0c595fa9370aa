"""The summary of a study: a row for each measure that an arm has, and one figure of all of them."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from coim.experiments.figures import summary as figure
from coim.experiments.figures.write import write_plot
from coim.experiments.statistics.intervals import interval, mean
from coim.experiments.statistics.summary import COLUMNS
from coim.experiments.study.arms import ARMS
from tests.experiments.made_up_study import check_words, read_table, write_cell

KINDS = ("first", "first", "optimised", "random", "optimised", "random")


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """Two environments; two runs that search, two that build random bodies, one under way, one alone."""
    expected = [None, None, *[(50.0, 10.0)] * 4]
    for seed, last in enumerate((10.0, 60.0)):
        cell = tmp_path, f"hopper-forward-grounded-{seed}", [1, 2, 60, 40, 80, last]
        write_cell(*cell, kinds=KINDS, num_designs=6, expected=expected)
        cell = tmp_path, f"hopper-forward-random-bodies-{seed}", [1, 2, 3, 4 + seed, 6, 5]
        write_cell(*cell, kinds=["first"] * 2 + ["random"] * 4, num_designs=6, predicted=(None, 1, 4, 2, 5, 3))
    cell = tmp_path, "hopper-forward-grounded-2", [1, 2, 90, 70, 80]
    write_cell(*cell, kinds=KINDS, num_designs=6, expected=expected)
    write_cell(tmp_path, "walker-backward-none-0", [1, 2, 3, 4, 5, 6], kinds=KINDS, num_designs=6)
    return tmp_path


def test_the_csv_has_each_measure_with_its_interval_and_leaves_out_what_an_arm_does_not_have(study: Path) -> None:
    (plot,) = figure.plots(study)
    write_plot(study, plot)
    rows = read_table(study / "summary.csv")
    assert list(rows[0]) == COLUMNS
    found = {(row["environment"], row["arm"], row["measure"]): row for row in rows}
    gains = found["hopper", "grounded", "search_gain"]
    assert (float(gains["mean"]), gains["runs"]) == ((70 - 25 + 70 - 50) / 2, "2")
    low, high = interval(mean, np.array([45.0, 20.0]))
    assert (float(gains["low"]), float(gains["high"])) == (low, high)
    assert float(found["hopper", "grounded", "coverage"]["mean"]) == (2 / 4 + 3 / 4) / 2
    assert {measure for _, arm, measure in found if arm == "random-bodies"} == {"area", "final", "rank_correlation"}
    alone = found["walker-backward", "none", "final"]
    assert (alone["mean"], alone["low"], alone["runs"]) == ("6", "", "1")  # one run has no interval
    assert not any(row["mean"] == "" for row in rows)
    assert not any(row["measure"] == "retrained" for row in rows)


def test_each_environment_has_its_panels_with_the_points_of_the_runs_and_the_interval(study: Path) -> None:
    (plot,) = figure.plots(study)
    check_words([plot])
    assert plot.figure is not None
    axes = plot.figure.axes
    assert [part.get_suptitle() for part in plot.figure.subfigs] == ["hopper, forward", "walker, backward"]
    names = ["search_gain", "area", "final", "rank_correlation", "coverage", "search_gain", "area", "final"]
    assert [panel.get_title() for panel in axes] == [figure.TITLES[name] for name in names]
    assert axes[0].get_title() == "searched minus random bodies\n(mean best return)"
    assert [label.get_text() for label in axes[0].child_axes[0].get_xticklabels()] == ["32"]  # of 32.5
    assert [label.get_text() for label in axes[0].get_xticklabels()] == ["grounded"]
    points, bar, level = axes[0].collections
    assert sorted(y for _, y in points.get_offsets()) == [20, 45]
    assert [y for _, y in level.get_segments()[0]] == [32.5, 32.5]
    assert sorted(y for _, y in bar.get_segments()[0]) == [20, 45]  # of two runs, the ends
    assert axes[0].lines[0].get_ydata()[0] == 0
    assert axes[0].get_xticks().tolist() == [0]
    row = next(row for row in plot.table if row["arm"] == "random-bodies")
    assert math.isnan(float(str(row["coverage"])))


@pytest.mark.parametrize("arms", [("none", "random-bodies", "grounded"), tuple(ARMS)[:8]], ids=["three", "eight"])
def test_names_of_arms_and_their_means_do_not_touch_each_other(tmp_path: Path, arms: tuple[str, ...]) -> None:
    for arm in arms:
        write_cell(tmp_path, f"hopper-forward-{arm}-0", [1001, 1002, 1003, 1004])
    (plot,) = figure.plots(tmp_path)
    assert plot.figure is not None
    plot.figure.draw_without_rendering()
    area = plot.figure.axes[1]
    assert area.get_title() == figure.TITLES["area"]
    for labels in (area.get_xticklabels(), area.child_axes[0].get_xticklabels()):
        boxes = [label.get_window_extent() for label in labels]
        assert len(boxes) == len(arms)
        assert all(left.x1 < right.x0 for left, right in pairwise(boxes))


def test_a_study_without_a_run_that_is_over_has_no_summary_yet(tmp_path: Path) -> None:
    write_cell(tmp_path, "hopper-forward-none-0", [1, 2])
    (plot,) = figure.plots(tmp_path)
    assert (plot.figure, plot.rows) == (None, ())
    assert "1 under way" in plot.notes[0]
