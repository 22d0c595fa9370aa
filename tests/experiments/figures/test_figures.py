"""The figures of a study: what is in their files, and what is said where something is not there."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from matplotlib.collections import LineCollection
from matplotlib.image import imread

from coim.experiments.commands.figures import main
from coim.experiments.figures import best_returns, comparisons, write
from coim.experiments.figures.plot import Plot
from coim.experiments.figures.write import write_figures
from coim.experiments.study.arms import ARMS
from tests.experiments.made_up_study import check_words, read_table, write_cell, write_ledger, write_table

RESULTS = Path(__file__).parents[3] / "docs" / "results"
DRAWN = ["figure_1_best_returns", "figure_3_best_returns", "statistics_arms", "statistics_pairs"]
DRAWN += ["statistics_predictions", "statistics_runs"]


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """Hopper, two arms with four and three runs, one of which diverged and one is under way."""
    for seed, last in enumerate((1.0, 2.0, 4.0, 9.0)):
        write_cell(tmp_path, f"hopper-forward-none-{seed}", [10, 20, 30, last], imagine="none")
    write_cell(tmp_path, "hopper-forward-known-0", [12, 22, 32, 42])
    write_cell(tmp_path, "hopper-forward-known-1", [14, 24], diverged=[0])
    write_cell(tmp_path, "hopper-forward-known-2", [10, 14, 40])
    return tmp_path


@pytest.mark.usefixtures("undrawn")
def test_figures_of_a_study_that_is_not_ours_go_where_out_says_and_over_nothing_of_others(
    study: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coim.experiments.figures.write.MODULES", (comparisons,))
    out = tmp_path_factory.mktemp("mine")
    (out / "README.md").write_text("# Mine")
    with pytest.raises(SystemExit, match=r"README.md is no page of figures .* with --out"):
        main([str(study), "--out", str(out)])
    assert (out / "README.md").read_text() == "# Mine"
    main([str(study), "--out", str(out / "figures")])
    assert (out / "figures" / "statistics_arms.png").is_file()
    assert not (study / "figures").exists()

    def refuse(folder: Path, plot: Plot) -> None:
        raise PermissionError(13, "Permission denied", str(folder))

    monkeypatch.setattr("coim.experiments.figures.write.write_plot", refuse)
    with pytest.raises(SystemExit, match=r"figures cannot be written to \(Permission denied\); .* with --out"):
        main([str(study)])


def test_every_figure_has_its_three_files_and_a_place_on_the_page(study: Path, capsys: pytest.CaptureFixture) -> None:
    main([str(study)])
    folder, said = study / "figures", capsys.readouterr().out
    page = (folder / "README.md").read_text()
    for name in DRAWN:
        height, width, _ = imread(folder / f"{name}.png").shape
        assert min(height, width) > 250
        assert (folder / f"{name}.pdf").read_bytes().startswith(b"%PDF")
        assert read_table(folder / f"{name}.csv")
        assert f"![{name}]({name}.png)" in page
        assert f"{name}: written" in said
    assert "6 of 7 runs are over, 1 under way, 0 to come; 1 of them diverged" in page
    assert f"figure_2_retrained: nothing to draw. No design was retrained: coim retrain {study}" in said
    assert "Not drawn. No design was retrained" in page


@pytest.mark.usefixtures("undrawn")
def test_the_csv_of_figure_1_holds_mean_iqm_interval_and_each_run(study: Path) -> None:
    write_figures(study)
    rows = read_table(study / "figures" / "figure_1_best_returns.csv")
    value = {(row["arm"], row["series"], row["design"]): row for row in rows if row["series"] != "run"}
    assert float(value["none", "mean", "4"]["best_return"]) == 4
    assert float(value["none", "IQM", "4"]["best_return"]) == 3  # of 1, 2, 4, 9 the middle two
    low, high = (float(value["none", "mean", "4"][end]) for end in ("low", "high"))
    assert 1 < low < 4 < high < 9
    assert float(value["known", "mean", "2"]["best_return"]) == (22 + 24 + 14) / 3
    assert value["known", "mean", "3"]["runs"] == "3"
    assert float(value["known", "mean", "3"]["best_return"]) == pytest.approx((32 + 1 + 40) / 3)  # diverged counts as 1
    # The run under way has no fourth design yet: what the diverged one counts there waits for it.
    assert (value["known", "mean", "4"]["runs"], float(value["known", "mean", "4"]["best_return"])) == ("1", 42)
    single = [row for row in rows if (row["arm"], row["series"], row["seed"]) == ("known", "run", "1")]
    assert [float(row["best_return"]) for row in single] == [14, 24]


@pytest.mark.usefixtures("undrawn")
def test_the_table_of_arms_counts_planned_and_diverged_runs(study: Path) -> None:
    names = [f"hopper-forward-{arm}-{seed}" for arm in ("none", "known") for seed in range(5)]
    write_ledger(study, dict.fromkeys(names, "waiting"))
    write_figures(study)
    none, known = read_table(study / "figures" / "statistics_arms.csv")
    assert [known[key] for key in ("arm", "planned", "over", "diverged", "diverged_share")] == [
        "known", "5", "2", "1", "0.3333333",
    ]  # fmt: skip
    assert float(known["final_mean"]) == (42 + 24) / 2
    assert float(known["bias_random"]) == pytest.approx(0.3 - 4.2)  # of runs that are over, as all in the row
    assert [float(none[key]) for key in ("final_iqm_low", "final_iqm_high")] == [30, 30]
    assert float(none["area_iqm_low"]) < float(none["area_iqm"]) < float(none["area_iqm_high"])
    assert float(known["area_mean"]) == pytest.approx((27 + (14 + 24 + 1 + 1) / 4) / 2)
    assert (none["over"], float(none["final_iqm"])) == ("4", 30)
    text = (study / "figures" / "statistics_arms.md").read_text()
    assert "| hopper | forward | known | 5 | 2 | 1 | " in text
    assert "nan" not in text
    assert "6 of 10 runs are over, 1 under way, 3 to come" in text


def test_figures_repeat_to_the_last_bit(study: Path) -> None:
    write_figures(study)
    first = {path.name: path.read_bytes() for path in (study / "figures").iterdir()}
    write_figures(study)
    assert first == {path.name: path.read_bytes() for path in (study / "figures").iterdir()}


@pytest.mark.usefixtures("undrawn")
def test_other_arms_have_a_figure_with_their_family_and_its_baselines(study: Path) -> None:
    write_cell(study, "hopper-forward-oracle-0", [1, 2, 3, 4])
    write_cell(study, "hopper-forward-control-only-0", [1, 2, 3, 4])
    write_figures(study)
    arms = {
        name: {row["arm"] for row in read_table(study / "figures" / f"{name}.csv")}
        for name in ("figure_1_best_returns", "best_returns_imagination", "best_returns_bodies")
    }
    assert arms == {
        "figure_1_best_returns": {"none", "known"},
        "best_returns_imagination": {"none", "known", "oracle"},
        "best_returns_bodies": {"none", "control-only"},
    }


def test_a_baseline_that_another_family_draws_has_no_figure_for_itself(tmp_path: Path) -> None:
    for arm in ("grounded", "grounded-known"):
        write_cell(tmp_path, f"hopper-forward-{arm}-0", [1, 2, 3, 4])
    plots = drawn(tmp_path)
    assert {row["arm"] for row in plots["best_returns_grounded"].rows} == {"grounded", "grounded-known"}
    assert "best_returns_bodies" not in plots


def test_several_environments_and_tasks_stand_in_one_figure(study: Path) -> None:
    narrow = drawn(study)["figure_3_best_returns"]
    for task in ("forward", "backward"):
        for arm in ("none", "known"):
            write_cell(study, f"half_cheetah-{task}-{arm}-0", [1, 2, 3, 4])
            write_cell(study, f"walker-{task}-{arm}-0", [1, 2, 3, 4])
    plots = drawn(study)
    wide = plots["figure_3_best_returns"]
    assert [len(plot.figure.axes) for plot in (narrow, wide) if plot.figure] == [2, 3 * 2 * 2]
    assert len({(row["environment"], row["task"]) for row in wide.rows}) == 5
    lone = [row["low"] for row in wide.rows if row["environment"] == "walker" and row["series"] != "run"]
    assert all(math.isnan(float(str(low))) for low in lone)  # one run has no interval
    assert [row["environment"] for row in plots["statistics_pairs"].rows].count("all") == 2


def test_the_band_of_figure_1_and_the_bars_of_the_arms_are_those_of_the_csv(study: Path) -> None:
    plots = drawn(study)
    rows = plots["figure_1_best_returns"].rows
    none = [row for row in rows if (row["arm"], row["series"]) == ("none", "mean")]
    axes = plots["figure_1_best_returns"].figure.axes[0]
    (line,) = (line for line in axes.lines if line.get_linewidth() == 1.6 and line.get_linestyle() == "-")
    assert line.get_ydata().tolist() == [row["best_return"] for row in none]
    band = axes.collections[1 if axes.collections[0].get_facecolor()[0][2] < 0.5 else 0].get_paths()[0].vertices
    for row in none:
        at = band[band[:, 0] == row["design"]][:, 1]
        assert {row["low"], row["high"]} <= {*at}
    arms = {row["arm"]: row for row in plots["statistics_arms"].rows}
    axes = plots["statistics_arms"].figure.axes[0]
    bars = [path.get_segments()[0] for path in axes.collections if isinstance(path, LineCollection)]
    upright = {round(bar[0][0]): (bar[0][1], bar[1][1]) for bar in bars if bar[0][0] == bar[1][0]}
    for x, arm in enumerate(("none", "known")):
        assert upright[x] == (arms[arm]["area_iqm_low"], arms[arm]["area_iqm_high"])


def test_each_point_of_the_pairs_stands_beside_the_name_of_its_pair(study: Path) -> None:
    write_cell(study, "hopper-forward-oracle-0", [90, 90, 90, 90])
    write_cell(study, "hopper-forward-oracle-1", [90, 90, 90, 90])
    plot = drawn(study)["statistics_pairs"]
    expected = {f"{row['arm']} over {row['against']}": row for row in plot.rows if row["measure"] == "area"}
    axes = plot.figure.axes[0]
    labels = [label.get_text().splitlines()[0] for label in axes.get_yticklabels()]
    assert sorted(labels) == sorted(expected)
    points = {line.get_ydata()[0]: line for line in axes.lines if line.get_marker() != "None"}
    bars = {
        line.get_ydata()[0]: line for line in axes.lines if line.get_marker() == "None" and line.get_linestyle() == "-"
    }
    for y, label in enumerate(labels):
        row = expected[label]
        assert points[y].get_xdata() == [row["improvement"]]
        assert list(bars[y].get_xdata()) == [row["improvement_low"], row["improvement_high"]]
    assert expected["oracle over none"]["improvement"] == 1
    assert expected["known over none"]["improvement"] < 1


def test_a_panel_without_a_run_says_so_and_the_one_above_has_the_numbers(study: Path) -> None:
    write_cell(study, "half_cheetah-forward-none-0", [1, 2, 3, 4])
    write_cell(study, "half_cheetah-backward-none-0", [1, 2, 3, 4])
    write_ledger(study, {"hopper-forward-none-0": "waiting", "hopper-backward-none-0": "waiting"})
    figure = drawn(study)["figure_1_best_returns"].figure
    titles = [axes.get_title() for axes in figure.axes]
    empty = [axes for axes in figure.axes if not axes.get_title()]
    assert "hopper, backward" not in titles
    assert {axes.texts[0].get_text() for axes in empty} == {"hopper, backward:\nno design is finished yet"}
    lowest = [axes for axes in figure.axes if axes.get_xlabel()]
    assert {axes.get_title() for axes in lowest} == {"hopper, forward", "half_cheetah, backward"}
    assert all(axes.xaxis.get_tick_params()["labelbottom"] for axes in lowest)


def drawn(study: Path) -> dict[str, Plot]:
    return {plot.name: plot for module in (best_returns, comparisons) for plot in module.plots(study)}


def test_a_study_that_has_just_begun_says_what_is_missing_and_keeps_no_old_figure(tmp_path: Path) -> None:
    (tmp_path / "cells" / "hopper-forward-none-0").mkdir(parents=True)
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "statistics_arms.png").write_bytes(b"old")
    found = write_figures(tmp_path)
    drawn = [plot.name for plot in found if plot.figure is not None]
    assert drawn == ["figure_4c_cartpole"]  # which follows from equations alone
    assert {path.stem for path in (tmp_path / "figures").iterdir()} == {"README", *drawn}
    assert "No run of none has finished a design yet." in (tmp_path / "figures" / "README.md").read_text()


def test_a_study_of_which_every_run_diverged_at_once_is_told_not_drawn(tmp_path: Path) -> None:
    folder = write_cell(tmp_path, "hopper-forward-none-0", [float("nan")], diverged=[0])
    write_table(folder / "designs.csv", ["run", "design", "kind", "predicted", "best_return"], [])
    found = {plot.name: plot for plot in write_figures(tmp_path)}
    assert found["statistics_arms"].figure is None
    assert "1 of them diverged" in found["statistics_arms"].notes[0]


def test_the_page_tells_what_the_arms_do_and_places_of_other_arms_have_no_panel(tmp_path: Path) -> None:
    write_cell(tmp_path, "hopper-forward-control-only-0", [10, 20, 30, 40])
    write_cell(tmp_path, "hopper-forward-none-0", [10, 20, 30, 40])
    write_cell(tmp_path, "walker-forward-oracle-0", [10, 20, 30, 40])
    figures = drawn(tmp_path)
    assert {row["environment"] for row in figures["figure_1_best_returns"].rows} == {"hopper"}
    figure = figures["figure_1_best_returns"].figure
    assert figure is not None
    assert "walker" not in " ".join(text.get_text() for axes in figure.axes for text in axes.texts)
    page = write.page(tmp_path, [])
    assert "| control-only | imagines nothing and keeps one body | none |" in page
    assert "| known |" not in page


@pytest.mark.usefixtures("undrawn")
def test_captions_are_short_and_tables_narrow_in_any_state_of_a_study(study: Path, tmp_path: Path) -> None:
    check_words(write_figures(study))
    empty = tmp_path / "empty"
    (empty / "cells" / "hopper-forward-none-0").mkdir(parents=True)
    check_words(write_figures(empty))
    for seed, arm in enumerate(ARMS):
        write_cell(study, f"walker-backward-{arm}-{seed + 10}", [10, 20, 30, 40])
    found = write_figures(study)
    check_words(found)
    page = (study / "figures" / "README.md").read_text()
    assert max(line.count(" | ") + 1 for line in page.splitlines() if line.startswith("| ")) == 10
    pairs = next(plot for plot in found if plot.name == "statistics_pairs")
    assert set(pairs.table[0]) < set(pairs.rows[0])  # the rest is in the CSV


@pytest.mark.parametrize("path", sorted(RESULTS.rglob("*.md")), ids=lambda path: path.relative_to(RESULTS).as_posix())
def test_tables_and_captions_of_the_results_are_short_too(path: Path) -> None:
    lines = path.read_text().splitlines()
    assert max((line.count("|") - 1 for line in lines if line.startswith("|")), default=0) <= 10
    for image, caption in zip(lines, lines[2:]):
        if image.startswith("!["):
            assert len(caption.split()) <= 60 + 2  # and the links to the files


@pytest.mark.usefixtures("undrawn")
def test_figures_that_are_called_otherwise_now_leave_none_behind(study: Path) -> None:
    write_figures(study)
    page = study / "figures" / "README.md"
    page.write_text(page.read_text() + "\n## figure_4a_model_error_hopper\n")
    for suffix in ("png", "csv"):
        (study / "figures" / f"figure_4a_model_error_hopper.{suffix}").touch()
        (study / "figures" / f"mine.{suffix}").touch()
    write_figures(study)
    there = {path.stem for path in (study / "figures").iterdir()}
    assert "figure_4a_model_error_hopper" not in there
    assert there >= {"mine", "figure_1_best_returns"}


@pytest.mark.usefixtures("undrawn")
def test_runs_of_several_revisions_are_told_on_the_page(study: Path) -> None:
    write_figures(study)
    page = study / "figures" / "README.md"
    assert "All runs were made at revision unknown." in page.read_text()
    for seed, revision in enumerate(("a" * 40, "b" * 40)):
        path = study / "cells" / f"hopper-forward-none-{seed}" / "config.json"
        config = json.loads(path.read_text()) | {"revision": revision}
        config["resumed"] = [{"at": "then"}, {"at": "now", "revision": "c" * 40}][: 1 + seed]
        path.write_text(json.dumps(config))
    write_figures(study)
    told = f"1 at {12 * 'a'}, 1 at {12 * 'b'} and {12 * 'c'}, 5 at unknown"
    assert f"**Runs of different revisions are compared: {told}.**" in page.read_text()


def test_a_folder_that_has_a_measured_run_alone_has_figure_4(tmp_path: Path) -> None:
    (tmp_path / "model_error").mkdir()
    main([str(tmp_path)])
    assert (tmp_path / "figures" / "figure_4c_cartpole.png").is_file()
    assert "figure_1" not in (tmp_path / "figures" / "README.md").read_text()


def test_a_folder_that_is_no_study_is_refused_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="is no study's folder: it has no cells/"):
        main([str(tmp_path)])
    assert list(tmp_path.iterdir()) == []
