"""A run whose models are measured: it is the run that it would have been, and it can be stopped."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from interrupted_runs import power_cut
from matplotlib.collections import QuadMesh
from tensordict import TensorDict
from tiny_runs import TINY, without_page
from tiny_runs import run as run_alone

from coim import HopperMorph, Policy
from coim.experiments.commands.model_error import main
from coim.experiments.figures import design_plane, error_curves
from coim.experiments.frames import read_frame
from coim.experiments.model_error.run import probe, write_design_space
from coim.experiments.model_error.tables import CHANGES, ERRORS
from coim.experiments.run.settings import Settings
from tests.experiments.made_up_study import check_words

PROBES = ["seen", "never built", "noisy", "noisy possible", "random", "random possible"]
OPTIONS = ["--num-designs", "4", "--first-episodes", "2", "--episodes", "2", "--episode-steps", "6", "--num-cells", "8"]
OPTIONS += ["--individual-updates", "2", "--population-updates", "2", "--model-updates", "2", "--model-cells", "8"]
OPTIONS += ["--batch-size", "10", "--num-particles", "4", "--num-iterations", "2", "--num-start-states", "3"]
OPTIONS += ["--threads", "1", "--no-compile", "--no-native-episodes", "--quiet"]


def measure(folder: Path, *options: str) -> Path:
    """One line on the command line, without the pictures of an ordinary run."""
    with without_page(), pytest.MonkeyPatch.context() as patched:
        patched.setattr("coim.experiments.model_error.run.SIDE", 5)
        main(["hopper", *OPTIONS, "--every", "2", "--rows", "5", "--out", str(folder), *options])
    return folder


def read(path: Path) -> list[dict[str, str]]:
    """Rows without what a clock said."""
    with path.open(newline="") as file:
        return [{k: v for k, v in row.items() if "seconds" not in k} for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study with one measured run."""
    folder = tmp_path_factory.mktemp("study")
    measure(folder / "model_error")
    return folder


def test_measuring_changes_nothing_in_the_run(study: Path, tmp_path: Path) -> None:
    alone = run_alone(tmp_path / "alone")
    for name in ("evaluations.csv", "designs.csv", "metrics.csv"):
        assert read(study / "model_error" / name) == read(alone / name)


def test_everything_is_measured_for_three_predictions_and_the_next_design_before_it_is_learnt(study: Path) -> None:
    rows = read(study / "model_error" / "model_error.csv")
    told = [(int(row["design"]), int(row["episode"]), row["probe"]) for row in rows if row["predict"] == "next"]
    expected = []
    for design in (1, 2, 3, 4):
        expected += [(design, 0, "next")] * (design > 1) + [(design, 2, name) for name in PROBES]
    assert told == expected
    for predict in ("delta", "nothing"):
        assert [row["probe"] for row in rows if row["predict"] == predict] == [name for _, _, name in expected]
    assert [int(row["env_steps"]) for row in rows if row["probe"] == "seen"][::3] == [12, 24, 36, 48]
    # Of each design five rows are kept.
    assert [int(row["rows"]) for row in rows if row["probe"] == "seen"][::3] == [5, 10, 15, 20]
    assert all(float(row["mse"]) >= 0 and float(row["normalised"]) >= 0 for row in rows if int(row["rows"]))
    for row in rows:
        if row["probe"] in ("noisy", "random"):
            (possible,) = (
                other["rows"]
                for other in rows
                if (other["probe"], other["predict"], other["env_steps"])
                == (f"{row['probe']} possible", row["predict"], row["env_steps"])
            )
            assert int(possible) == round(5 * (1 - float(row["impossible"])))


@pytest.mark.parametrize("saves", [1, 4, 8])
def test_a_stopped_measurement_goes_on_by_the_same_line_to_the_same_numbers(
    study: Path, tmp_path: Path, saves: int
) -> None:
    with power_cut(saves):
        measure(tmp_path / "cut")
    measure(tmp_path / "cut")
    for name in ("model_error.csv", "design_space.csv", "evaluations.csv"):
        assert read(tmp_path / "cut" / name) == read(study / "model_error" / name)


def test_both_models_learn_from_the_same_batches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = Settings(**{**vars(TINY), "num_designs": 2, "num_runs": 2})
    measured = probe(HopperMorph, settings, tmp_path, every=1, rows=4)
    own, other = measured.algorithm.dynamics, measured.other
    assert (own.ensemble.predict, other.ensemble.predict) == ("delta", "next")
    # Let the other one predict the same, too: then nothing is left in which they could differ.
    other.ensemble.predict = "delta"
    monkeypatch.setattr(measured, "_write", lambda *args, **kwargs: None)
    list(measured)
    for key, value in own.ensemble.state_dict().items():
        assert torch.equal(value, other.ensemble.state_dict()[key]), key


def test_each_probe_is_driven_by_the_policy_that_it_tells_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measured = probe(HopperMorph, Settings(**{**vars(TINY), "num_designs": 2}), tmp_path, every=2, rows=4)
    drivers = []
    for name in ("trajectory", "unseen_trajectories"):
        collect = getattr(measured.probes, name)

        def noted(policy: Policy, *args: torch.Tensor, collect: Callable = collect, **kwargs: int) -> TensorDict:
            drivers.append(policy)
            return collect(policy, *args, **kwargs)

        monkeypatch.setattr(measured.probes, name, noted)
    list(measured)
    individual, population = measured.algorithm.individual.policy, measured.algorithm.population.policy
    seen, next_design, never_built = individual, population, population
    assert [driver is individual for driver in drivers] == [
        driver is individual for driver in (seen, never_built, next_design, seen, never_built)
    ]


def test_a_fleet_has_a_row_for_each_run(tmp_path: Path) -> None:
    settings = Settings(**{**vars(TINY), "num_designs": 1, "num_runs": 2})
    list(probe(HopperMorph, settings, tmp_path, every=2, rows=4))
    rows = read(tmp_path / ERRORS.file)
    assert [row["run"] for row in rows] == ["0", "1"] * (len(rows) // 2)
    assert rows[0]["mse"] != rows[1]["mse"]


def test_a_run_of_a_fleet_that_diverges_is_measured_no_more_and_is_not_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = Settings(**{**vars(TINY), "num_designs": 3, "num_runs": 2})
    measured = probe(HopperMorph, settings, tmp_path, every=1, rows=4)
    monkeypatch.setattr("coim.experiments.model_error.run.SIDE", 3)
    learner, losses = measured.algorithm.population, []
    learn = learner.update

    def spoil(batches: TensorDict) -> TensorDict:
        losses.append(learn(batches))
        if len(losses) == 2:
            learner.weights_by_run()[0][0] = torch.nan
        return losses[-1]

    monkeypatch.setattr(learner, "update", spoil)
    list(measured)
    assert measured.divergence.places == {0: (0, 1)}
    rows = read(tmp_path / ERRORS.file)
    assert {(row["design"], row["episode"]) for row in rows if row["run"] == "0"} == {("1", "1")}
    assert {row["design"] for row in rows if row["run"] == "1"} == {"1", "2", "3"}
    write_design_space(measured, HopperMorph, tmp_path)
    drawn = {row["xi_torso"] for row in read(tmp_path / "design_space.csv") if row["point"] == "tried"}
    own = [rows["design"][0, 1, 0].item() for rows in measured.seen]
    assert sorted(map(float, drawn)) == pytest.approx(sorted(own), rel=1e-6)
    measured.divergence.places[1] = (2, 1)
    assert "the run diverged" in write_design_space(measured, HopperMorph, tmp_path)


def test_the_speed_that_is_shown_counts_the_second_model_too(tmp_path: Path) -> None:
    measured = probe(HopperMorph, Settings(**{**vars(TINY), "model_updates": 5}), tmp_path, every=2, rows=4)
    assert (measured.algorithm.updates_per_episode, measured.updates_per_episode) == (2 + 2 + 5, 2 + 2 + 5 + 5)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--every", "3"], r"measured with \{'every': 2, 'rows': 5\}, not with \{'every': 3"),
        (["--seed", "3"], r"seed \(0 to 3\)"),
    ],
)
def test_what_would_change_the_past_is_refused(study: Path, options: list[str], sentence: str) -> None:
    with pytest.raises(SystemExit, match=sentence):
        measure(study / "model_error", *options)


def test_a_run_that_nobody_measured_and_one_without_a_model_are_refused(tmp_path: Path) -> None:
    run_alone(tmp_path / "alone", num_designs=1)
    with pytest.raises(SystemExit, match="nothing was measured in the run"):
        measure(tmp_path / "alone")
    with pytest.raises(SystemExit, match="learns no model"):
        main(["hopper", "--preset", "quick", "--imagine", "none", "--out", str(tmp_path / "none")])


def test_too_few_designs_for_two_components_are_told(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    options = [name for name in OPTIONS if name != "--quiet"]
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("test_model_error.OPTIONS", options)
        measure(tmp_path / "one", "--num-designs", "1")
    assert "no design_space.csv: designs on one line, 1 in all" in capsys.readouterr().out
    assert [plot.figure for plot in design_plane.plots(tmp_path)] == [None]


def test_a_run_that_ended_before_anything_was_measured_says_so(tmp_path: Path) -> None:
    measured = probe(HopperMorph, TINY, tmp_path, every=2, rows=4)
    assert "before its first measurement" in write_design_space(measured, HopperMorph, tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_figures_show_what_was_measured(study: Path) -> None:
    (errors,), (space,) = error_curves.plots(study), design_plane.plots(study)
    assert (errors.name, space.name) == ("figure_4a_model_error_hopper", "figure_4b_design_space_hopper")
    measured = read(study / "model_error" / "model_error.csv")
    written = read_frame(study / "model_error" / ERRORS.file, ERRORS)
    pd.testing.assert_frame_equal(pd.DataFrame(errors.rows)[list(measured[0])].astype(written.dtypes), written)
    panels = errors.figure.axes
    assert [axes.get_yscale() for axes in panels] == ["log"] * 4
    kinds = [(column, predict) for column in ("normalised", "mse") for predict in ("delta", "next")]
    for axes, (column, predict) in zip(panels, kinds, strict=True):
        drawn = {line.get_label(): line.get_xydata() for line in axes.lines}
        for probe_name in ("next", *PROBES):
            own, still = (
                {int(row["env_steps"]): float(row[column]) for row in measured if is_of(row, probe_name, of)}
                for of in (predict, "nothing")
            )
            expected = [(x, y / still[x] if column == "normalised" else y) for x, y in own.items() if math.isfinite(y)]
            np.testing.assert_allclose(drawn[probe_name], np.array(expected).reshape(-1, 2), rtol=1e-6)
        assert ("no change" in drawn) == (column == "normalised")
    last = [row for row in measured if is_of(row, "seen", "next") or is_of(row, "seen", "nothing")][-2:]  # of 48 steps
    share = float(last[0]["normalised"]) / float(last[1]["normalised"])
    assert errors.table[0]["learns the next observation"] == f"{share:.3g}"
    check_words([errors, space])


def is_of(row: dict[str, str], probe_name: str, predict: str) -> bool:
    return (row["probe"], row["predict"]) == (probe_name, predict)


def test_each_panel_of_the_design_space_has_the_colours_of_its_state_and_source_where_they_belong(study: Path) -> None:
    (space,) = design_plane.plots(study)
    rows = read(study / "model_error" / "design_space.csv")
    written = read_frame(study / "model_error" / CHANGES.file, CHANGES)
    pd.testing.assert_frame_equal(pd.DataFrame(space.rows).astype(written.dtypes), written)
    states = sorted({row["state"] for row in rows})
    panels = [(state, source) for state in states for source in ("delta", "next", "simulator")]
    assert len(space.figure.axes) == len(panels) + 1  # and the scale of the colours
    for axes, (state, source) in zip(space.figure.axes, panels):
        grid = [row for row in rows if (row["state"], row["point"]) == (state, "grid")]
        (mesh,) = (found for found in axes.collections if isinstance(found, QuadMesh))
        corners, values = mesh.get_coordinates(), np.ma.masked_invalid(mesh.get_array())
        shown = np.zeros(values.shape, bool)
        for row in grid:
            place = float(row["pc_1"]), float(row["pc_2"])
            there = ((corners[:-1, :-1] < place) & (place < corners[1:, 1:])).all(-1)
            assert there.sum() == 1
            shown |= there
            assert values.filled(math.nan)[there] == pytest.approx(float(row[f"normalised/{source}"]), nan_ok=True)
        assert len({*values.compressed()}) > 5
        assert values.mask[~shown].all()  # out of bounds


def test_a_measured_run_without_a_measurement_yet_is_told_not_drawn(study: Path, tmp_path: Path) -> None:
    folder = tmp_path / "model_error"
    folder.mkdir()
    (folder / "config.json").write_text((study / "model_error" / "config.json").read_text())
    (folder / ERRORS.file).write_text(",".join(ERRORS.header()) + "\n")
    (plot,) = error_curves.plots(tmp_path)
    assert plot.figure is None
    assert f"There is no measurement yet in {folder / ERRORS.file}" in plot.caption


def test_without_its_input_a_figure_says_what_to_run(tmp_path: Path) -> None:
    for module in (error_curves, design_plane):
        (plot,) = module.plots(tmp_path)
        assert plot.figure is None
        assert f"coim model-error ENVIRONMENT --out {tmp_path / 'model_error'}" in plot.caption
