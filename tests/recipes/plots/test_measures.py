"""What a run comes to, what a diverged one counts, and how arms are compared."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from recipes.plots.measures import comparisons, measure, paired, pairs_of_arms, welch
from recipes.plots.runs import parts_of, read_runs
from tests.recipes.made_up_study import write_cell, write_table


def test_area_is_the_mean_over_designs_and_final_the_highest(tmp_path: Path) -> None:
    write_cell(tmp_path, "hopper-forward-known-0", [10, 40, 20, 30])
    (run,) = read_runs(tmp_path).found
    found = measure(run, failure=-100)
    assert (run.state, found.area, found.final) == ("finished", 25, 40)
    assert found.correlation == pytest.approx(stats.spearmanr([1, 2, 3], [40, 20, 30]).statistic)
    # (1 - .9) Q against best return / 10 steps: .1 - 4, .2 - 2, .3 - 3
    assert found.bias == pytest.approx((-3.9 - 1.8 - 2.7) / 3)
    assert found.hours == pytest.approx(8 * 36 / 3600)
    assert found.updates == 8 * (5 + 3 + 2)


def test_who_learns_no_model_has_no_updates_of_it(tmp_path: Path) -> None:
    write_cell(tmp_path, "hopper-forward-none-0", [10, 40, 20, 30], designs="none")
    write_cell(tmp_path, "hopper-forward-oracle-0", [10, 40, 20, 30], dream="simulator")
    assert [measure(run, failure=0).updates for run in read_runs(tmp_path).found] == [8 * (5 + 3)] * 2


def test_a_diverged_run_counts_with_the_lowest_return_of_its_place_on_what_it_did_not_reach(tmp_path: Path) -> None:
    write_cell(tmp_path, "hopper-forward-known-0", [10, 40], diverged=[0])
    write_cell(tmp_path, "hopper-forward-none-0", [-6, 10, 10, 10])
    write_cell(tmp_path, "hopper-backward-none-0", [-99, 10, 10, 10])  # another task, another scale
    runs = read_runs(tmp_path)
    failure = runs.failure(("hopper", "forward"))
    (broken,) = runs.of(("hopper", "forward"), "known")
    assert failure == -6
    assert broken.state == "diverged"
    assert broken.best_returns(failure).tolist() == [10, 40, -6, -6]
    found = measure(broken, failure)
    assert (found.area, found.final) == (9.5, 40)  # the body that it had found before is still there
    assert "1 of them diverged" in runs.in_words(["known", "none"])


def test_a_run_under_way_has_no_area_yet_and_its_last_design_no_best_return(tmp_path: Path) -> None:
    folder = write_cell(tmp_path, "hopper-forward-known-0", [10, 40, 20])
    lines = (folder / "designs.csv").read_text().splitlines()
    (folder / "designs.csv").write_text("\n".join(lines[:-1]) + "\n")  # design 3 still has episodes to come
    (run,) = read_runs(tmp_path).found
    assert [row["design"] for row in run.designs] == [1, 2]
    assert run.state == "under way"
    assert math.isnan(measure(run, failure=0).area)
    assert np.isnan(run.best_returns(0)).tolist() == [False, False, True, True]


def test_each_run_of_a_fleet_counts_and_the_ledger_says_what_is_to_come(tmp_path: Path) -> None:
    write_cell(tmp_path, "hopper-forward-control-only-0", [1, 2, 3, 4], [5, 6], diverged=[1])
    names = ["hopper-forward-control-only-0", "hopper-forward-none-0", "half_cheetah-backward-none-0"]
    write_table(tmp_path / "ledger.csv", ["cell", "state"], [[name, "waiting"] for name in names])
    runs = read_runs(tmp_path)
    assert [(run.number, run.state) for run in runs.found] == [(0, "finished"), (1, "diverged")]
    assert runs.places == [("hopper", "forward"), ("half_cheetah", "backward")]
    assert runs.arms == ["none", "control-only"]
    assert sum(runs.planned.values()) == 6  # cells that have not begun will be as large
    assert runs.in_words(runs.arms).startswith("2 of 6 runs are over, 0 under way, 4 to come; 1 of them diverged")


def test_a_cell_of_another_name_is_refused_and_so_is_a_folder_without_cells(tmp_path: Path) -> None:
    assert parts_of("half_cheetah-backward-random-bodies-12") == ("half_cheetah", "backward", "random-bodies", 12)
    with pytest.raises(ValueError, match="hopper-forward-none-0"):
        parts_of("hopper-forward-none")
    with pytest.raises(ValueError, match="it has no cells/"):
        read_runs(tmp_path)


def test_every_arm_meets_the_baseline_and_each_way_to_imagine_the_one_that_it_changes() -> None:
    assert pairs_of_arms(["none", "known", "random", "control-only", "oracle"]) == [
        ("known", "none"),
        ("random", "none"),
        ("control-only", "none"),
        ("oracle", "none"),
        ("random", "known"),
        ("oracle", "random"),
    ]


def test_welch_is_the_hand_computed_one() -> None:
    x, y = np.array([1.0, 2.0, 3.0]), np.array([2.0, 4.0, 6.0, 8.0])
    a, b = 1 / 3, (20 / 3) / 4  # variances of the means
    t, freedom = (2 - 5) / math.sqrt(a + b), (a + b) ** 2 / (a**2 / 2 + b**2 / 3)
    assert welch(x, y) == pytest.approx(2 * stats.t.sf(abs(t), freedom))
    assert math.isnan(welch(x[:1], y))
    assert math.isnan(welch(np.ones(3), np.zeros(3)))
    assert 0 < welch(np.zeros(3), y) < 0.1  # an arm of which every run diverged


def test_paired_is_the_hand_computed_one() -> None:
    difference = np.array([1.0, 2.0, 3.0])
    assert paired(difference) == pytest.approx(2 * stats.t.sf(2 / math.sqrt(1 / 3), 2))
    assert math.isnan(paired(np.ones(1)))
    assert math.isnan(paired(np.ones(4)))


def test_comparisons_pair_by_seed_correct_each_measure_by_itself_and_join_the_places(tmp_path: Path) -> None:
    mine, theirs = [30.0, 10.0, 50.0], [11.0, 5.0, 28.0]
    for task in ("forward", "backward"):
        for seed in range(3):
            write_cell(tmp_path, f"hopper-{task}-known-{seed}", [mine[seed]] * 4)
            write_cell(tmp_path, f"hopper-{task}-none-{seed}", [theirs[seed]] * 4)
    write_cell(tmp_path, "hopper-forward-none-7", [20.0] * 4)  # has no partner
    runs = read_runs(tmp_path)
    rows = comparisons(runs, [measure(run, failure=0) for run in runs.found])
    assert [(row["measure"], row["task"]) for row in rows] == [
        (name, task) for name in ("area", "final") for task in ("backward", "forward", "all")
    ]
    forward, both = rows[1], rows[2]
    assert (forward["runs"], forward["runs_against"], forward["pairs"]) == (3, 4, 3)
    assert forward["difference"] == pytest.approx(30 - 16)
    assert forward["improvement"] == pytest.approx((4 + 1 + 4) / 12)
    assert forward["welch_p"] == pytest.approx(stats.ttest_ind(mine, [*theirs, 20.0], equal_var=False).pvalue)
    assert forward["paired_p"] == pytest.approx(stats.ttest_rel(mine, theirs).pvalue)
    assert forward["paired_p_holm"] == pytest.approx(2 * stats.ttest_rel(mine, theirs).pvalue)  # two places
    assert both["improvement"] == pytest.approx((9 / 12 + 7 / 9) / 2)
    assert (both["runs"], both["runs_against"]) == (6, 7)
    assert math.isnan(float(str(both["welch_p"])))
