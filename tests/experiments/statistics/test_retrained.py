"""Fig. 2: what is drawn, what is told of it, and how its arms are tested."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from coim.experiments.figures import from_scratch
from coim.experiments.figures.plot import Plot
from coim.experiments.figures.write import write_figures
from coim.experiments.statistics import retrained as retrained_pairs
from coim.experiments.statistics.measures import comparisons, measures, welch
from coim.experiments.statistics.retrained import interval_over_runs, pairs, with_retrained
from coim.experiments.study.runs import read_runs
from tests.experiments.made_up_study import check_words, read_table, write_cell, write_ledger, write_table

PLACE = ("hopper", "forward")
Chosen = Sequence[tuple[int, str, float]]  # seed, body and best return, NaN where it diverged without one


def write_retrained(
    study: Path, arms: Mapping[str, Chosen], environment: str = "hopper", task: str = "forward", **noted: object
) -> list[dict[str, object]]:
    """Retrained designs of one place in a study of one cell; returns what stands in designs.csv."""
    (study / "cells" / "hopper-forward-none-0").mkdir(parents=True, exist_ok=True)
    lines: list[dict[str, object]] = []
    for arm, chosen in arms.items():
        for index, (seed, xi, best) in enumerate(chosen):
            cell = f"{environment}-{task}-{arm}-{seed}"
            name = f"{cell}-run0-design{index}"
            line = {"folder": name, "cell": cell, "environment": environment, "task": task, "arm": arm}
            lines.append(line | {"seed": seed, "run": 0} | {"design": index, "xi": xi, "found_return": 30} | noted)
            diverged = [0] if math.isnan(best) else []
            write_cell(study, name, [best], part="retrained/cells", diverged=diverged, num_designs=1, first_episodes=9)
    list_designs(study, lines)
    return lines


def list_designs(study: Path, lines: Sequence[Mapping[str, object]]) -> None:
    write_table(study / "retrained" / "designs.csv", list(lines[0]), [list(line.values()) for line in lines])


def of_seeds(*returns: float) -> list[tuple[int, str, float]]:
    return [(seed, "1 1", value) for seed, value in enumerate(returns)]


def drawn(study: Path) -> tuple[Plot, Plot]:
    designs, tests = from_scratch.plots(study)
    return designs, tests


def test_boxes_are_quartiles_and_points_are_the_best_returns_of_the_retrained_designs(tmp_path: Path) -> None:
    write_retrained(tmp_path, {"none": of_seeds(1, 2, 3), "known": of_seeds(2, 4, 6, 8)})
    figure = drawn(tmp_path)[0].figure
    assert figure is not None
    (axes,) = figure.axes
    assert [label.get_text() for label in axes.get_xticklabels()] == ["none\nn = 3", "known\nn = 4"]
    points = [np.asarray(mark.get_offsets()) for mark in axes.collections]
    assert [cloud[:, 1].tolist() for cloud in points] == [[1, 2, 3], [2, 4, 6, 8]]
    assert [cloud[:, 0].round().tolist() for cloud in points] == [[0, 0, 0], [1, 1, 1, 1]]
    medians = [line.get_ydata()[0] for line in axes.lines if line.get_linewidth() == 1.6]
    assert medians == [2, 5]
    boxes = [patch.get_path().vertices[:, 1] for patch in axes.patches]
    assert [(box.min(), box.max()) for box in boxes] == [(1.5, 2.5), (3.5, 6.5)]
    flat = [line.get_ydata() for line in axes.lines if len(line.get_ydata()) == 2 and line.get_linewidth() != 1.6]
    assert {y for y, other in flat if y == other} == {1, 3, 2, 8}  # whiskers end at the last design


@pytest.mark.usefixtures("undrawn")
def test_figure_2_and_its_tests_are_written_with_their_numbers(tmp_path: Path) -> None:
    lines = write_retrained(tmp_path, {"none": of_seeds(1, 2, 3), "known": of_seeds(2, 4, 6, 8)})
    list_designs(tmp_path, [*lines, lines[0] | {"folder": "not-yet", "arm": "known"}])
    plot = next(plot for plot in write_figures(tmp_path) if plot.name == "figure_2_retrained")
    rows = read_table(tmp_path / "figures" / "figure_2_retrained.csv")
    assert [float(row["best_return"]) for row in rows] == [1, 2, 3, 2, 4, 6, 8]
    assert "7 of 8 designs are retrained, 0 of them diverged." in plot.notes
    check_words(drawn(tmp_path))
    (row,) = read_table(tmp_path / "figures" / "figure_2_tests.csv")
    expected = stats.ttest_ind([2, 4, 6, 8], [1, 2, 3], equal_var=False).pvalue
    assert float(row["difference"]) == 3
    assert float(row["welch_designs_p"]) == pytest.approx(expected, rel=1e-6)
    text = (tmp_path / "figures" / "figure_2_tests.md").read_text()
    shown = rf"\| known \| none \| 4 \| 4 \| 3 \([^|]* to [^|]*\) \| {expected:.3g} \|"
    assert re.search(shown, text)


def test_each_arm_says_how_many_designs_bodies_and_runs_it_has(tmp_path: Path) -> None:
    known = [(0, "1 1", 1.0), (0, "2 1", 2.0), (0, "2 1", 3.0), (4, "2 1", 4.0)]
    write_retrained(tmp_path, {"none": of_seeds(1), "known": known}, found=50, kept=4)
    designs, tests = drawn(tmp_path)
    assert [designs.rows[-1][f"arm_{name}"] for name in ("designs", "bodies", "runs")] == [4, 2, 2]
    assert (
        "known: 4 designs, distinct bodies 2, runs 2, chosen as the best of each run, 4 of 50 (8 %)"
        in designs.notes[-1]
    )
    (row,) = tests.rows
    assert [row[name] for name in ("designs", "bodies", "runs")] == [4, 2, 2]
    assert [row[f"{name}_against"] for name in ("designs", "bodies", "runs")] == [1, 1, 1]
    assert all(math.isnan(row[test]) for test in ("welch_designs_p", "welch_runs_p"))  # too few for a test


def test_runs_are_drawn_with_all_their_designs(monkeypatch: pytest.MonkeyPatch) -> None:
    x, y = [np.ones(3), np.array([5.0])], [np.zeros(2), np.zeros(1)]
    assert interval_over_runs(x, y) == (1, 5)  # both times the same run: in one of four draws each
    monkeypatch.setattr(retrained_pairs, "CONFIDENCE", 0.2)
    assert interval_over_runs(x, y) == (2, 2)  # in the other two, the mean of 1, 1, 1 and 5
    assert all(map(math.isnan, interval_over_runs(x, y[:1])))


def rows_of(arm: str, *runs: Sequence[float], environment: str = "hopper") -> list[dict[str, object]]:
    """As in the CSV of Fig. 2."""
    head = {"environment": environment, "task": "forward", "arm": arm, "run": 0, "xi": "1 1"}
    return [head | {"seed": seed, "best_return": value} for seed, returns in enumerate(runs) for value in returns]


def test_designs_of_one_run_are_one_sample_of_the_test_over_runs() -> None:
    mine, theirs = ([4, 5, 6], [9, 10], [6]), ([1, 2, 3], [5, 6, 7])
    (row,) = pairs(pd.DataFrame([*rows_of("none", *theirs), *rows_of("known", *mine)])).to_dict("records")
    over_designs = stats.ttest_ind(np.concatenate(mine), np.concatenate(theirs), equal_var=False).pvalue
    over_runs = stats.ttest_ind([5, 9.5, 6], [2, 6], equal_var=False).pvalue
    assert (row["arm"], row["against"]) == ("known", "none")
    assert row["difference"] == pytest.approx(40 / 6 - 4)
    assert row["welch_designs_p"] == pytest.approx(over_designs)
    assert row["welch_runs_p"] == pytest.approx(over_runs)
    assert 3 * over_designs < over_runs


def test_holms_correction_is_over_the_table() -> None:
    rows = []
    for environment, step in (("hopper", 3.0), ("walker", 1.0)):
        rows += rows_of("none", [0, 1], [2], [1], environment=environment)
        rows += rows_of("known", [step, step + 1], [step + 2], [step], environment=environment)
    first, second = pairs(pd.DataFrame(rows)).to_dict("records")
    for test in ("welch_designs_p", "welch_runs_p"):
        assert first[test] < second[test]
        assert first[f"{test}_holm"] == pytest.approx(2 * first[test])
        assert second[f"{test}_holm"] == second[test]


def test_a_line_for_each_pair_shows_the_difference_and_its_interval(tmp_path: Path) -> None:
    write_retrained(
        tmp_path, {"none": of_seeds(0, 0), "known": of_seeds(1, 3), "noisy": [(0, "1 1", 5.0), (0, "1 1", 7.0)]}
    )
    figure = drawn(tmp_path)[1].figure
    assert figure is not None
    (axes,) = figure.axes
    names = dict(zip(axes.get_yticks(), (label.get_text() for label in axes.get_yticklabels())))
    shown = [(names.get(line.get_ydata()[0]), list(line.get_xdata())) for line in axes.lines]
    assert ("known minus none", [1, 3]) in shown
    assert ("known minus none", [2]) in shown
    assert ("noisy minus none", [6]) in shown
    assert ("noisy minus known", [4]) in shown


def test_the_notes_tell_what_was_eligible_and_how_long_it_was_trained(tmp_path: Path) -> None:
    write_retrained(tmp_path, {"none": of_seeds(1, 2)})
    designs, tests = drawn(tmp_path)
    assert "9 episodes of plain SAC from scratch" in designs.notes[0]
    assert "return in the study after 2 episodes. First and random designs are left out" in designs.notes[1]
    assert (tests.figure, tests.caption) == (None, "No two arms that are compared have retrained designs.")


@pytest.mark.parametrize(("kept", "told"), [((18, 9), False), ((18, 18), True), ((18, 10), True)])
def test_shares_that_differ_by_more_than_rounding_are_told(tmp_path: Path, kept: tuple[int, int], told: bool) -> None:
    lines = write_retrained(tmp_path, {"none": of_seeds(1), "known": of_seeds(2)})
    list_designs(
        tmp_path, [line | {"found": found, "kept": k} for line, found, k in zip(lines, (250, 125), kept, strict=True)]
    )
    assert ("The shares differ" in drawn(tmp_path)[0].notes[-1]) == told


def test_a_retraining_without_a_return_counts_with_the_lowest_of_its_place_and_a_note_says_so(
    tmp_path: Path,
) -> None:
    write_retrained(tmp_path, {"none": of_seeds(4, 2), "known": of_seeds(9, math.nan)})
    designs, _ = drawn(tmp_path)
    assert [(row["best_return"], row["replaced"]) for row in designs.rows] == [(4, 0), (2, 0), (9, 0), (2, 1)]
    assert (
        "4 of 4 designs are retrained, 1 of them diverged; 1 without a return until then: counts with the lowest best "
        "return of its place." in designs.notes
    )


def test_the_lowest_return_is_that_of_the_same_task(tmp_path: Path) -> None:
    lines = write_retrained(tmp_path, {"none": of_seeds(-90), "known": of_seeds(-80)}, task="backward")
    lines += write_retrained(tmp_path, {"none": of_seeds(4, 2), "known": of_seeds(9, math.nan)})
    list_designs(tmp_path, lines)
    designs, _ = drawn(tmp_path)
    found = [(row["task"], row["best_return"]) for row in designs.rows]
    assert sorted(found) == [("backward", -90), ("backward", -80), *(("forward", best) for best in (2, 2, 4, 9))]


def test_a_retraining_that_diverged_later_counts_with_what_it_had(tmp_path: Path) -> None:
    write_retrained(tmp_path, {"none": of_seeds(4)})
    write_cell(tmp_path, "late", [7], part="retrained/cells", diverged=[0], num_designs=1)
    (line,) = read_table(tmp_path / "retrained" / "designs.csv")
    list_designs(tmp_path, [line, line | {"folder": "late", "seed": "1"}])
    designs, _ = drawn(tmp_path)
    assert [row["best_return"] for row in designs.rows] == [4, 7]
    assert "1 of them diverged; these count with the best return until then." in designs.notes[2]
    assert "lowest" not in designs.notes[2]


def test_each_run_of_a_fleet_retrains_a_design_of_its_own(tmp_path: Path) -> None:
    lines = write_retrained(tmp_path, {"known": of_seeds(4, 5)}, trained="")
    fleet = "hopper-forward-known-fleet0"
    write_cell(tmp_path, fleet, [7], [9], part="retrained/cells", num_designs=1)
    list_designs(tmp_path, [line | {"trained": f"{fleet}/{run}"} for run, line in enumerate(lines)])
    designs, _ = drawn(tmp_path)
    assert [(row["seed"], row["best_return"]) for row in designs.rows] == [(0, 7), (1, 9)]


def test_where_no_retraining_has_a_return_designs_are_left_out_and_counted(tmp_path: Path) -> None:
    lost = {"none": of_seeds(math.nan), "known": of_seeds(math.nan, math.nan)}
    lines = write_retrained(tmp_path, lost)
    for plot in drawn(tmp_path):
        assert plot.figure is None
        assert plot.caption.startswith("None of 3 designs is retrained yet")
        assert plot.caption.endswith("; 3 diverged before their first return.")
    others = write_retrained(tmp_path, {"none": of_seeds(1, 2), "known": of_seeds(3)}, environment="walker")
    list_designs(tmp_path, [*lines, *others])
    designs, tests = drawn(tmp_path)
    assert [row["best_return"] for row in designs.rows] == [1, 2, 3]
    assert {row["environment"] for row in tests.rows} == {"walker"}
    assert (
        "6 of 6 designs are retrained, 3 of them diverged; 3 left out, as no retraining of their environment and task "
        "has a return." in designs.notes
    )


def test_designs_that_were_chosen_before_the_study_grew_say_so(tmp_path: Path) -> None:
    for seed in range(2):
        write_cell(tmp_path, f"hopper-forward-known-{seed}", [1, 2, 3, 4])
    write_retrained(tmp_path, {"known": of_seeds(1)}, over=2, planned=2)
    (tmp_path / "cells" / "hopper-forward-none-0").rmdir()
    assert "Chosen before" not in " ".join(drawn(tmp_path)[0].notes)
    write_ledger(tmp_path, {f"hopper-forward-known-{seed}": "waiting" for seed in range(5)})
    assert (
        "Chosen before all runs were over (hopper, forward, known: 2 of 5 planned now); designs of the others had no "
        "chance." in drawn(tmp_path)[0].notes
    )


def test_the_best_body_of_each_run_is_compared_by_what_its_retraining_earned(tmp_path: Path) -> None:
    chosen = {"none": [1.0, 2.0], "random-bodies": [1.5, 0.5]}
    for arm, returns in chosen.items():
        for seed in range(len(returns)):
            write_cell(tmp_path, f"hopper-forward-{arm}-{seed}", [10, 20, 30, 40])
    lines = write_retrained(tmp_path, {arm: of_seeds(*returns) for arm, returns in chosen.items()})
    write_cell(tmp_path, "second", [99], part="retrained/cells", num_designs=1)
    list_designs(tmp_path, [*lines, lines[0] | {"folder": "second", "design": 7, "found_return": 29}])  # not the best
    runs = read_runs(tmp_path)
    measured = with_retrained(measures(runs), tmp_path)
    assert measured.set_index(["arm", "seed"])["retrained"].to_dict() == {
        (arm, seed): value for arm, returns in chosen.items() for seed, value in enumerate(returns)
    }
    (row,) = (row for row in comparisons(runs, measured).to_dict("records") if row["measure"] == "retrained")
    assert (row["arm"], row["against"], row["improvement"]) == ("random-bodies", "none", 0.25)  # of four pairs one
    list_designs(tmp_path, [lines[1]])
    assert with_retrained(measures(runs), tmp_path)["retrained"].notna().sum() == 1
    (tmp_path / "retrained" / "designs.csv").unlink()
    assert with_retrained(measures(runs), tmp_path)["retrained"].isna().all()


@pytest.mark.parametrize(
    ("chosen", "over_designs", "over_runs"),
    [("each run", 0.23, 0.05), ("all together", 0.38, 0.14), ("all", 0.34, 0.05)],
)
def test_the_tests_find_differences_that_are_not_there_as_often_as_is_said(
    chosen: str, over_designs: float, over_runs: float
) -> None:
    rng, studies = np.random.default_rng(0), 1000

    def arm() -> list[np.ndarray]:
        """Five runs with five designs of one distribution; those of each run that are retrained."""
        bodies = rng.normal(size=(5, 1)) + 0.5 * rng.normal(size=(5, 5))
        found, new = bodies + 0.5 * rng.normal(size=(5, 5)), bodies + 0.5 * rng.normal(size=(5, 5))
        kept = np.ones((5, 5), bool)
        if chosen == "each run":
            kept = found >= np.sort(found, axis=1)[:, 2:3]  # the best three
        elif chosen == "all together":
            kept = found >= np.sort(found, axis=None)[12]  # the best thirteen
        return [of_run[those] for of_run, those in zip(new, kept) if those.any()]

    rejected = np.zeros(2)
    for _ in range(studies):
        x, y = arm(), arm()
        rejected[0] += welch(np.concatenate(x), np.concatenate(y)) < 0.05
        rejected[1] += welch(np.array([r.mean() for r in x]), np.array([r.mean() for r in y])) < 0.05
    assert rejected / studies == pytest.approx([over_designs, over_runs], abs=0.04)  # 2.5 standard errors
