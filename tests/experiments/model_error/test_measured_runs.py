"""Fig. 4(a) and (b) of several measured runs: what is joined, what is kept apart, and what is drawn of it."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import pytest

from coim.experiments.figures import design_plane, error_curves
from coim.experiments.figures.plot import Plot
from coim.experiments.model_error.tables import CHANGES, ERRORS, errors, late_share
from tests.experiments.made_up_study import check_words, write_table

STEPS = (10, 20, 30, 40)


def write_measured(
    study: Path,
    name: str,
    *runs: Sequence[float],
    environment: str = "hopper",
    still: float = 2.0,
    steps: Sequence[int] = STEPS,
    **settings: object,
) -> Path:
    """A folder in which "seen" was measured, the error of the model of changes of each run as given, the other's 1."""
    folder = study / "model_error" / name
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps({"environment": environment, "settings": settings}))
    lines = []
    for i, step in enumerate(steps):
        for predict in ("delta", "next", "nothing"):
            for run, values in enumerate(runs):
                if i < len(values):
                    error = {"delta": values[i], "next": 1.0, "nothing": still}[predict]
                    lines.append([run, 1, i + 1, step, "seen", predict, 10 * error, error, 5, ""])
    write_table(folder / ERRORS.file, ERRORS.header(), lines)
    return folder


def lines_of(plot: Plot, panel: int, label: str) -> list[list[list[float]]]:
    """Points of the lines with a label in a panel."""
    return [line.get_xydata().tolist() for line in plot.figure.axes[panel].lines if line.get_label() == label]


def series(plot: Plot, name: str) -> list[dict]:
    return [dict(row) for row in plot.rows if row["series"] == name and row["predict"] == "delta"]


def test_folders_and_runs_of_a_fleet_are_runs_of_one_figure_with_an_interval(tmp_path: Path) -> None:
    write_measured(tmp_path, "hopper-0", [2, 1, 1, 1], seed=0)
    write_measured(tmp_path, "hopper-1", [1, 1, 1, 0.5], [6, 4, 1, 0.3], seed=1, still=4.0)
    (plot,) = error_curves.plots(tmp_path)
    assert plot.name == "figure_4a_model_error_hopper"
    assert lines_of(plot, 0, "_seen") == [
        [[10, 1], [20, 0.5], [30, 0.5], [40, 0.5]],
        [[10, 0.25], [20, 0.25], [30, 0.25], [40, 0.125]],
        [[10, 1.5], [20, 1], [30, 0.25], [40, 0.075]],
    ]
    (mean,) = lines_of(plot, 0, "seen")
    assert [y for _, y in mean] == pytest.approx([2.75 / 3, 1.75 / 3, 1 / 3, 0.7 / 3])
    (raw,) = lines_of(plot, 2, "seen")
    assert [y for _, y in raw] == pytest.approx([30, 20, 10, 6])
    assert [(row["folder"], row["seed"], row["run"]) for row in series(plot, "run")] == [
        ("model_error/hopper-0", 0, 0)
    ] * 4 + [("model_error/hopper-1", 1, 0), ("model_error/hopper-1", 1, 1)] * 4
    means = series(plot, "mean")
    assert [(row["env_steps"], row["runs"]) for row in means] == [(step, 3) for step in STEPS]
    assert [row["share"] for row in means] == pytest.approx([y for _, y in mean])
    # Three runs are drawn alike in 1 of 27 resamples, more than the 2.5 % beyond each end.
    assert (means[0]["share_low"], means[0]["share_high"]) == (0.25, 1.5)
    assert (means[3]["mse_low"], means[3]["mse_high"]) == (3, 10)
    assert "3 runs" in plot.caption
    assert plot.table[0]["learns the change"] == "0.233 (0.075 to 0.5)"  # the last of four
    assert "The runs differ" not in " ".join(plot.notes)
    check_words([plot])


def test_a_lone_run_has_neither_a_mean_nor_an_interval(tmp_path: Path) -> None:
    write_measured(tmp_path, "", [2, 1, 1, 1])
    (plot,) = error_curves.plots(tmp_path)
    assert lines_of(plot, 0, "_seen") == series(plot, "mean") == []
    assert "interval" not in plot.caption


def test_tasks_environments_and_ways_to_imagine_have_figures_of_their_own(tmp_path: Path) -> None:
    write_measured(tmp_path, "a", [2.0], task="forward", imagine="known")
    write_measured(tmp_path, "b", [4.0], task="backward", imagine="known")
    write_measured(tmp_path, "c", [6.0], task="backward", imagine="known", environment="walker")
    drawn = {plot.name: lines_of(plot, 0, "seen")[0][0][1] for plot in error_curves.plots(tmp_path)}
    stem = "figure_4a_model_error"
    expected = {f"{stem}_hopper_backward": 2.0, f"{stem}_hopper_forward": 1.0, f"{stem}_walker_backward": 3.0}
    assert drawn == expected
    write_measured(tmp_path, "d", [8.0], task="forward", imagine="noisy")
    names = [plot.name for plot in error_curves.plots(tmp_path)]
    assert names[1:3] == [f"{stem}_hopper_forward_known", f"{stem}_hopper_forward_noisy"]


def test_a_mean_is_of_steps_at_which_all_runs_that_had_got_so_far_were_measured(tmp_path: Path) -> None:
    write_measured(tmp_path, "often", [2.0, 4.0, 4.0, 8.0, 8.0], steps=(5, 10, 15, 20, 30))
    write_measured(tmp_path, "seldom", [6.0, 4.0], steps=(10, 20))  # and ends, or is under way
    (plot,) = error_curves.plots(tmp_path)
    assert lines_of(plot, 0, "seen") == [[[10, 2.5], [20, 3], [30, 4]]]
    assert [len(line) for line in lines_of(plot, 0, "_seen")] == [5, 2]
    assert [row["runs"] for row in series(plot, "mean")] == [2, 2, 1]
    assert "at the steps at which all runs that had got so far have a number" in " ".join(plot.notes)


def test_runs_that_differ_in_more_than_their_seed_are_told(tmp_path: Path) -> None:
    write_measured(tmp_path, "a", [2.0], seed=0, batch_size=256, out="a")
    write_measured(tmp_path, "b", [4.0], seed=1, batch_size=128, out="b")
    (plot,) = error_curves.plots(tmp_path)
    assert "The runs differ in more than their seed: batch_size." in plot.notes


def test_over_the_last_quarter_a_measurement_counts_by_how_much_moves_in_it() -> None:
    rows = []
    for step, error, still in ((60, 9, 9), (80, 0.003, 0.004), (100, 2, 8), (90, math.nan, math.nan)):
        for predict, value in (("delta", error), ("nothing", still)):
            place = {"folder": "a", "run": 0, "probe": "seen", "predict": predict, "env_steps": step}
            rows.append(place | {"normalised": value})
    table = pd.DataFrame(rows)
    value, low, high = late_share(table, "seen", "delta")
    assert value == pytest.approx(2.003 / 8.004)
    assert math.isnan(low)
    assert math.isnan(high)
    assert errors(table, "seen", "delta", "normalised").x.tolist() == [60, 80, 100]
    assert math.isnan(late_share(table, "next", "delta")[0])


def write_planes(folder: Path, change: float) -> None:
    """Two states of 2 x 2 points with one change everywhere."""
    sources = ("delta", "next", "simulator")
    columns = ["state", "point", "pc_1", "pc_2", *(f"normalised/{source}" for source in sources), "depth"]
    lines = []
    for state in (1, 2):
        lines += [[state, "grid", x, y, change, change, change, 0] for x in (0, 1) for y in (0, 1)]
        lines.append([state, "tried", 0, 0, 0, 0, 0, 0])
    write_table(folder / CHANGES.file, [*columns, "share_1", "share_2"], [[*line, 0.7, 0.2] for line in lines])


def test_of_several_folders_the_first_is_looked_into_and_the_others_are_named(tmp_path: Path) -> None:
    for name, change, task in (("a", 1, "forward"), ("b", 2, "backward"), ("c", 3, "forward")):
        write_planes(write_measured(tmp_path, name, [1.0], task=task), change)
    plots = {plot.name: plot for plot in design_plane.plots(tmp_path)}
    assert [*plots] == ["figure_4b_design_space_hopper_backward", "figure_4b_design_space_hopper_forward"]
    backward, forward = plots.values()
    assert [float(str(plot.rows[0]["normalised/next"])) for plot in (backward, forward)] == [2, 1]
    assert forward.notes[-1] == "The models are those of model_error/a, the first by name. Not drawn: model_error/c."
    check_words(plots.values())
    assert backward.notes[-1] == "The models are those of model_error/b."
