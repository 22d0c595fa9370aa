"""What a run comes to, what a diverged one counts, and how arms are compared."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from coim.experiments.frames import spearman, spearman_given
from coim.experiments.statistics.intervals import improvement, interval
from coim.experiments.statistics.measures import (
    comparisons,
    detectable,
    measure,
    measures,
    paired,
    welch,
)
from coim.experiments.statistics.retrained import with_retrained
from coim.experiments.study.arms import pairs_of_arms
from coim.experiments.study.definition import Study, to_json
from coim.experiments.study.runs import parts_of, read_runs
from tests.experiments.made_up_study import KINDS, read_table, write_cell, write_ledger, write_table

BY_NUMBER = dict(enumerate(KINDS, 1))


def test_area_is_the_mean_over_designs_and_final_the_highest(tmp_path: Path) -> None:
    write_cell(tmp_path, "hopper-forward-known-0", [10, 40, 20, 30])
    (run,) = read_runs(tmp_path).found
    found = measure(run, failure=-100, kinds=BY_NUMBER)
    assert (run.state, found["area"], found["final"]) == ("finished", 25, 40)
    assert found["search_gain"] == 20 - 30  # design 3 was searched for, design 4 drawn
    # (1 - .9) Q against best return / 10 steps, of design 3, which was searched for, and 4, which was drawn
    assert found["bias_optimised"] == pytest.approx(0.2 - 2)
    assert found["bias_random"] == pytest.approx(0.3 - 3)
    assert found["hours"] == pytest.approx(8 * 36 / 3600)
    assert found["updates"] == 8 * (5 + 3 + 2)
    assert math.isnan(found["episode_seconds"])


def test_the_seconds_of_an_episode_are_the_median_of_those_in_its_metrics(tmp_path: Path) -> None:
    folder = write_cell(tmp_path, "hopper-forward-known-0", [10, 40])
    places = [(0, design, episode) for design in (1, 2) for episode in (1, 2)]
    rows = [[*place, seconds] for place, seconds in zip(places, (90.0, 3.0, 5.0, 4.0), strict=True)]
    write_table(folder / "metrics.csv", ["run", "design", "episode", "seconds/episode"], rows)
    (run,) = read_runs(tmp_path).found
    assert measure(run, failure=0, kinds=BY_NUMBER)["episode_seconds"] == 4.5


def test_what_only_rises_with_the_order_of_building_correlates_but_not_given_the_order() -> None:
    q, best, order = [1.0, 2.0, 4.0, 3.0, 5.0, 6.0], [20, 10, 30, 50, 40, 60], [6, 7, 8, 9, 10, 11]
    # Independently: the correlation of what the order leaves of both ranks.
    ranks = [stats.rankdata(values) for values in (q, best, order)]
    left = [r - np.polyval(np.polyfit(ranks[2], r, 1), ranks[2]) for r in ranks[:2]]
    given = spearman_given(q, best, given=order)
    assert given == pytest.approx(stats.pearsonr(*left).statistic)
    assert given < 0 < spearman(q, best)


def test_a_correlation_given_what_determines_it_is_none() -> None:
    assert math.isnan(spearman_given([1.0, 2.0, 3.0, 4.0], [10, 20, 15, 30], given=[6, 7, 8, 9]))  # Q is the order


def test_first_designs_and_a_body_that_never_changes_say_nothing_of_the_ranking(tmp_path: Path) -> None:
    folder = write_cell(tmp_path, "hopper-forward-none-0", [10, 40, 20, 30], predicted=(None, 90.0, 2.0, 3.0))
    (run,) = read_runs(tmp_path).found
    assert measure(run, failure=0, kinds=BY_NUMBER)["bias_random"] == pytest.approx(
        0.3 - 3
    )  # and Q = 90 of a first design counts nowhere
    alike = {"kinds": [*KINDS, *KINDS[2:]], "num_designs": 6, "predicted": (90.0, 80.0, 2.0, 1.0, 4.0, 3.0)}
    write_cell(tmp_path / "longer", "hopper-forward-none-0", [0, 9, 20, 10, 40, 30], **alike)
    (longer,) = read_runs(tmp_path / "longer").found
    assert measure(longer, failure=0, kinds=BY_NUMBER)["rank_correlation"] == pytest.approx(1)
    for name in ("evaluations.csv", "designs.csv"):
        rows = read_table(folder / name)
        fixed = [row | {"kind": "fixed", "xi_1": "0.5"} for row in rows]
        write_table(folder / name, list(fixed[0]), [list(row.values()) for row in fixed])
    (run,) = read_runs(tmp_path).found
    found = measure(run, failure=0, kinds=BY_NUMBER)
    for value in (
        found["rank_correlation"],
        found["rank_correlation_raw"],
        found["bias_optimised"],
        found["bias_random"],
    ):
        assert math.isnan(value)


def test_what_a_posterior_expected_is_the_prediction_of_its_run_and_its_interval_is_counted(tmp_path: Path) -> None:
    kinds = ("first", "optimised", "random", "optimised", "random")
    expected = [None, (50.0, 10.0), (40.0, 10.0), (30.0, 10.0), (20.0, 10.0)]
    returns = [90, 50 + 16, 40 - 17, 30 + 17, 20 - 16]  # 1.645 deviations are within
    write_cell(tmp_path, "hopper-forward-grounded-0", returns, kinds=kinds, expected=expected, num_designs=5)
    write_cell(tmp_path, "hopper-forward-none-0", returns, kinds=kinds, num_designs=5)
    runs = {run.arm: measure(run, failure=0, kinds=BY_NUMBER) for run in read_runs(tmp_path).found}
    assert runs["grounded"]["coverage"] == 0.5
    assert math.isnan(runs["none"]["coverage"])
    assert runs["grounded"]["rank_correlation_raw"] == pytest.approx(spearman([4, 3, 2, 1], returns[1:]))
    assert runs["none"]["rank_correlation_raw"] == -runs["grounded"]["rank_correlation_raw"]  # Q rises
    assert runs["grounded"]["bias_optimised"] == pytest.approx(((50 - 66) + (30 - 47)) / 2 / 10)  # ten steps


def test_who_learns_no_model_has_no_updates_of_it(tmp_path: Path) -> None:
    write_cell(tmp_path, "hopper-forward-none-0", [10, 40, 20, 30], imagine="none")
    write_cell(tmp_path, "hopper-forward-oracle-0", [10, 40, 20, 30], dream="simulator")
    assert [measure(run, failure=0, kinds=BY_NUMBER)["updates"] for run in read_runs(tmp_path).found] == [
        8 * (5 + 3)
    ] * 2


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
    found = measure(broken, failure, runs.kinds(("hopper", "forward"), "known"))
    assert (found["area"], found["final"]) == (9.5, 40)  # the body that it had found before is still there
    assert math.isnan(found["search_gain"])  # no run of its arm came to a body that was searched for
    write_cell(tmp_path, "hopper-forward-known-1", [10, 40, 20, 5])
    write_cell(tmp_path, "hopper-forward-known-2", [10, 40, 20], diverged=[0])
    gains = measures(read_runs(tmp_path)).set_index(["task", "arm", "seed"])["search_gain"]
    assert gains["forward", "known"].to_dict() == {0: 0, 1: 15, 2: 20 + 6}
    assert "1 of them diverged" in runs.in_words(["known", "none"])


def test_a_run_under_way_has_no_area_yet_and_its_last_design_no_best_return(tmp_path: Path) -> None:
    kinds = {number + 2 * later: kind for later in (0, 1) for number, kind in BY_NUMBER.items()}
    folder = write_cell(tmp_path, "hopper-forward-known-0", [10, 40, 20, 5, 7], kinds=[*kinds.values()], num_designs=6)
    lines = (folder / "designs.csv").read_text().splitlines()
    (folder / "designs.csv").write_text("\n".join(lines[:-1]) + "\n")  # design 5 still has episodes to come
    (run,) = read_runs(tmp_path).found
    assert run.designs["design"].tolist() == [1, 2, 3, 4]
    assert run.state == "under way"
    assert math.isnan(measure(run, failure=0, kinds=BY_NUMBER)["area"])
    assert math.isnan(measure(run, failure=0, kinds=kinds)["search_gain"])
    assert np.isnan(run.best_returns(0)).tolist() == [False] * 4 + [True] * 2


def test_each_run_of_a_fleet_counts_and_the_ledger_says_what_is_to_come(tmp_path: Path) -> None:
    write_cell(tmp_path, "hopper-forward-control-only-0", [1, 2, 3, 4], [5, 6], diverged=[1])
    names = ["hopper-forward-control-only-0", "hopper-forward-none-0", "half_cheetah-backward-none-0"]
    write_ledger(tmp_path, dict.fromkeys(names, "waiting"))
    study = Study(
        name="made-up",
        environments=("half_cheetah",),
        tasks=("backward",),
        arms=("none",),
        seeds=(0, 1),
        seeds_per_cell=2,
        protocol="smoke",
    )
    (tmp_path / "study.json").write_text(to_json(study))
    runs = read_runs(tmp_path)
    assert [(run.number, run.state) for run in runs.found] == [(0, "finished"), (1, "diverged")]
    assert runs.places == [("hopper", "forward"), ("half_cheetah", "backward")]
    assert runs.arms == ["none", "control-only"]
    assert runs.planned["hopper", "forward", "control-only"] == 2
    assert runs.planned["half_cheetah", "backward", "none"] == 2  # as study.json has it
    assert runs.in_words(runs.arms).startswith("2 of 5 runs are over, 0 under way, 3 to come; 1 of them diverged")


def test_cells_that_were_given_up_are_neither_under_way_nor_to_come(tmp_path: Path) -> None:
    for seed, returns in enumerate(([10, 40, 20, 30], [10, 40], [10])):
        write_cell(tmp_path, f"hopper-forward-none-{seed}", returns)
    states = ("finished", "failed", "running", "failed", "waiting")
    write_ledger(tmp_path, {f"hopper-forward-none-{seed}": state for seed, state in enumerate(states)})
    runs = read_runs(tmp_path)
    assert [run.state for run in runs.found] == ["finished", "failed", "under way"]
    words = "1 of 5 runs are over, 1 under way, 1 to come, 2 failed (ledger.csv says why); none diverged."
    assert runs.in_words(["none"]) == words


def test_what_a_diverged_run_counts_and_runs_of_different_length_are_told(tmp_path: Path) -> None:
    write_cell(tmp_path, "hopper-forward-known-0", [10, 40], diverged=[0])
    write_cell(tmp_path, "hopper-forward-none-0", [-6, 10, 10, 10])
    write_cell(tmp_path, "hopper-forward-none-1", [8, 10], num_designs=6)
    runs = read_runs(tmp_path)
    assert "1 of them diverged" in (short := runs.in_words(["known", "none"]))
    assert "of the designs that they reached" in short
    words = runs.in_words(["known", "none"], counted=True)
    assert "on a design (hopper, forward: -6), on which the means and Welch's test depend" in words
    assert "until all are over their arm looks worse than it is" in words
    assert words.endswith("They are to try different numbers of designs: 4, 6.")


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


def test_an_arm_whose_baselines_were_left_out_meets_the_baselines_of_these() -> None:
    assert pairs_of_arms(["none", "grounded-known"]) == [("grounded-known", "none")]
    assert pairs_of_arms(["returns", "grounded-governed", "grounded-known"]) == [
        ("grounded-governed", "returns"),
        ("grounded-known", "returns"),
        ("grounded-governed", "grounded-known"),
    ]
    assert pairs_of_arms(["grounded-known", "control-only"]) == []


def test_the_detectable_difference_is_found_in_four_of_five_studies() -> None:
    rng = np.random.default_rng(0)
    x, y = np.array([1.0, 2.0, 6.0, 4.0, 3.0]), np.array([10.0, 30.0, 20.0])
    difference, count = detectable(x, y), 4000
    many_x = rng.normal(0.0, x.std(ddof=1), (count, len(x)))
    many_y = rng.normal(difference, y.std(ddof=1), (count, len(y)))
    found = stats.ttest_ind(many_x, many_y, axis=1, equal_var=False).pvalue < 0.05
    assert found.mean() == pytest.approx(0.8, abs=0.03)  # the freedom of Welch's test is itself estimated
    assert math.isnan(detectable(x[:1], y))


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
            write_cell(tmp_path, f"hopper-{task}-known-{seed + 1}", [mine[seed]] * 4)
            write_cell(tmp_path, f"hopper-{task}-none-{seed + 1}", [theirs[seed]] * 4)
    write_cell(tmp_path, "hopper-forward-none-0", [20.0] * 4)  # has no partner, and comes before those that have one
    runs = read_runs(tmp_path)
    rows = comparisons(runs, with_retrained(measures(runs), tmp_path)).to_dict("records")
    assert [(row["measure"], row["task"]) for row in rows] == [
        (name, task) for name in ("area", "final") for task in ("backward", "forward", "all")
    ]
    forward, both = rows[1], rows[2]
    assert (forward["runs"], forward["runs_against"], forward["pairs"]) == (3, 4, 3)
    assert forward["difference"] == pytest.approx(30 - 16)
    assert forward["paired_difference"] == pytest.approx((19 + 5 + 22) / 3)
    assert (forward["paired_difference_low"], forward["paired_difference_high"]) == (5, 22)  # of three, the ends
    assert -11 < forward["difference_low"] < 14 < forward["difference_high"] < 45
    assert forward["improvement"] == pytest.approx((4 + 1 + 4) / 12)
    low, high = interval(improvement, np.array(mine), np.array([20.0, *theirs]))
    assert (forward["improvement_low"], forward["improvement_high"]) == (low, high)
    assert 1 - high < low < high
    assert forward["welch_p"] == pytest.approx(stats.ttest_ind(mine, [*theirs, 20.0], equal_var=False).pvalue)
    assert forward["paired_p"] == pytest.approx(stats.ttest_rel(mine, theirs).pvalue)
    assert forward["paired_p_holm"] == pytest.approx(2 * stats.ttest_rel(mine, theirs).pvalue)  # two places
    assert both["improvement"] == pytest.approx((9 / 12 + 7 / 9) / 2)
    assert both["improvement_low"] < both["improvement"] < both["improvement_high"]
    assert (both["runs"], both["runs_against"]) == (6, 7)
    assert math.isnan(float(str(both["welch_p"])))
