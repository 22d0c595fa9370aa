"""The benchmarks at sizes of a second: that each row can be measured, and that the floors count what they should."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import pytest
import torch

from benchmarks.__main__ import ROWS, Options, main
from benchmarks.effort import FULL, Effort
from benchmarks.floors import (
    alone,
    design_value_products,
    ensemble_products,
    flop,
    forward,
    imagination_products,
    sac_products,
    weight_gradients,
)
from benchmarks.libraries import verdict
from benchmarks.measure import Figure, Target, interleaved, over
from benchmarks.rivals import RIVALS
from benchmarks.table import heading, machine, text
from benchmarks.updates import too_few_cores
from coim.experiments.run.machine import available_cores
from coim.products import Choice

TINY = Effort(
    repeats=2,
    long_repeats=1,
    threads=(1,),
    runs=(1, 3),
    fleets=(1, 2),
    batch_size=8,
    num_cells=(8, 8),
    model_cells=(8, 8),
    updates=3,
    imagined_rows=50,
    num_particles=4,
    num_iterations=2,
    num_start_states=3,
    searched=("hopper",),
    individual_updates=2,
    population_updates=2,
    model_updates=2,
    episode_steps=10,
    fleet_steps=4,
    replay_rows=200_000,
)
SIZES = {"observations": 17, "designs": 6, "actions": 6}


def test_the_floor_of_an_update_is_what_the_equations_need() -> None:
    policy, critic = 23 * 200 + 200 * 200 + 200 * 200 + 200 * 12, 29 * 200 + 200 * 200 + 200 * 200 + 200 * 1
    multiplications = (
        512 * policy  # actions at s and s'
        + 2 * 256 * critic  # target critics at the next action
        + 2 * 512 * critic  # critics at the stored and the new action
        + 2 * 512 * (critic - 29 * 200)  # errors of both back through the critics' hidden layers
        + 2 * 256 * critic  # weight gradients, of the stored action's error alone
        + 2 * 256 * 6 * 200  # and back to the new action
        + 256 * (policy - 23 * 200)  # back through the policy's hidden layers
        + 256 * policy  # the policy's weight gradients
    )
    counted = flop(sac_products(batch=256, cells=(200, 200, 200), **SIZES))
    assert counted == 2 * multiplications
    assert round(counted / 1e9, 2) == 0.69


def test_the_floors_of_the_other_parts_are_what_the_equations_need() -> None:
    model = 29 * 500 + 2 * 500 * 500 + 500 * 34
    policy, critic = 23 * 200 + 2 * 200 * 200 + 200 * 12, 29 * 200 + 2 * 200 * 200 + 200 * 1
    update = ensemble_products(batch=256, cells=(500, 500, 500), **SIZES)
    assert flop(update) == 2 * 3 * 256 * (model + model + model - 29 * 500)
    dreamt = imagination_products(chunks=[300, 100], cells=(200,) * 3, model_cells=(500,) * 3, **SIZES)
    assert flop(dreamt) == 2 * 400 * (policy + model)  # one member for each row, whatever the rows are divided into
    valued = design_value_products(chunks=[36, 72], cells=(200,) * 3, **SIZES)
    assert flop(valued) == 2 * 108 * (policy + 2 * critic)


@pytest.mark.parametrize("by", [None, Choice("torch", "emulated")])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_floor_takes_every_product(by: Choice | None, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    """Counted where the work is done: rows times columns times what is summed over."""
    done = []

    def product(a: torch.Tensor, b: torch.Tensor, *rest: torch.Tensor, **kwargs: torch.Tensor) -> torch.Tensor:
        done.append(2 * a.shape[0] * a.shape[1] * b.shape[1])
        assert a.dtype == b.dtype == dtype
        return a @ b

    monkeypatch.setattr("benchmarks.floors.torch.mm", product)
    monkeypatch.setattr("benchmarks.floors.affine", product)
    monkeypatch.setattr("benchmarks.floors.input_gradient", lambda delta, weight: product(delta, weight.t()))
    monkeypatch.setattr("benchmarks.floors.weight_gradient", lambda x, delta: product(x.t(), delta))
    listed = sac_products(batch=4, cells=(5, 5), **SIZES)
    alone(listed, times=3, by=by, dtype=dtype)()
    assert sum(done) == 3 * flop(listed)
    assert len(done) == 3 * len(listed)


def test_products_are_of_layers() -> None:
    one, two = forward("a", 7, [2, 3, 4])
    assert [(p.layer, p.rows, p.inputs, p.outputs) for p in (one, two)] == [(0, 7, 2, 3), (1, 7, 3, 4)]
    assert flop([one]) == 2 * 7 * 2 * 3
    assert [p.kind for p in weight_gradients("a", 7, [2, 3, 4])] == ["weight", "weight"]


@pytest.mark.parametrize("name", [name for name in ROWS if name not in RIVALS])
def test_a_row_is_measured(name: str) -> None:
    figures = ROWS[name](TINY)  # type: ignore[index]
    assert figures
    for figure in figures:
        if available_cores() < 2 and figure.note == too_few_cores(2):
            continue  # what takes two cores is told of where there is one
        assert figure.ratios, figure
        assert all(math.isfinite(ratio) and ratio > 0 for ratio in figure.ratios)
        assert all(math.isfinite(amount) for amount in figure.amounts)
        assert (figure.met is None) == (figure.target is None)


@pytest.mark.parametrize("name", list(RIVALS))
def test_a_library_that_is_not_there_is_said_to_be_missing(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda module: None)
    figures = ROWS[name](TINY)  # type: ignore[index]
    assert figures
    for figure in figures:
        assert not figure.ratios
        assert figure.met is None
        assert "make bench" in figure.note


def test_more_threads_than_cores_are_not_measured() -> None:
    (figure,) = ROWS["torchrl"](dataclasses.replace(TINY, threads=(4096,)))
    assert not figure.ratios
    assert "needs 4096 cores" in figure.note


def test_an_iteration_side_by_side_is_not_measured_on_one_core(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.iteration.available_cores", lambda: 1)
    *others, beside = ROWS["iteration"](TINY)
    assert all(figure.ratios for figure in others)
    assert not beside.ratios
    assert "needs 2 cores" in beside.note


def test_a_library_that_beats_the_chosen_one_is_told() -> None:
    assert verdict("float32", "torch", {"torch": (1.0, 1.02), "onednn": (1.0, 1.0)}) == "chosen by the table"
    told = verdict("float32", "torch", {"torch": (1.5, 1.5), "onednn": (1.0, 1.0)})
    assert told.startswith("THE TABLE IS WRONG HERE: onednn is 1.50 x as fast; mend FASTEST[")


def test_actions_take_turns_and_the_first_of_each_does_not_count() -> None:
    calls: list[str] = []
    times = interleaved({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, 2)
    assert calls == ["a", "b"] * 3
    assert [len(seconds) for seconds in times.values()] == [2, 2]
    assert over([1.0, 6.0], [2.0, 3.0]) == (0.5, 2.0)


def test_targets_are_met_by_medians() -> None:
    figure = Figure(row="a", against="b", ratios=(1.0, 1.2, 9.0), amounts=(7.0,) * 3, target=Target(1.25))
    assert (figure.ratio, figure.met) == (1.2, True)
    assert dataclasses.replace(figure, target=Target(1.2, sense="<")).met is False
    assert dataclasses.replace(figure, target=Target(8, of="amount", sense=">=")).met is False
    assert dataclasses.replace(figure, target=None).met is None
    assert str(Target(8_000, of="amount", sense=">=")) == ">= 8,000"
    assert str(Target(1.25)) == "<= 1.25 x"


def test_the_table_is_aligned_and_honest() -> None:
    figures = [
        Figure(row="fast", against="floor", ratios=(1.0, 1.2, 1.1), target=Target(1.25)),
        Figure(row="slow", against="floor", ratios=(1.5,), amounts=(12_345.6,), unit="rows/s", target=Target(1.25)),
        Figure(row="absent", against="floor", target=Target(1.25), note="not installed"),
    ]
    head, rule, fast, slow, absent = text(figures).splitlines()
    assert set(rule) == {"-"}
    start = head.index("met")
    assert [line[start:][:3].strip() for line in (fast, slow, absent)] == ["yes", "NO", "-"]
    assert "12,346 rows/s" in slow
    assert "(1 - 1.2)" in fast
    assert absent.endswith("not installed")
    assert "core" in heading(machine())


def test_the_program_prints_one_table_and_writes_json(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("benchmarks.__main__.FULL", TINY)
    monkeypatch.chdir(tmp_path)
    main(Options(only=("products",)))
    assert "products of an update, 1 thread, bfloat16 emulated" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []  # a part is no result
    monkeypatch.setattr("benchmarks.__main__.ROWS", {"products": ROWS["products"]})  # as if that were all
    main(Options(only=("products",)))
    assert [path.parent.name for path in tmp_path.rglob("benchmarks-*.json")] == ["runs"]
    main(Options(only=("products",), out=tmp_path / "found" / "part.json"))
    content = json.loads((tmp_path / "found" / "part.json").read_text())
    assert content["machine"].keys() >= {"processor", "cores", "threads", "versions", "revision"}
    for figure in content["figures"]:
        assert figure["ratio"]["min"] <= figure["ratio"]["median"] <= figure["ratio"]["max"]
        assert figure["repeats"] == TINY.repeats


def test_the_published_sizes_are_the_papers() -> None:
    assert (FULL.batch_size, FULL.num_cells, FULL.model_cells) == (256, (200, 200, 200), (500, 500, 500))
    assert (FULL.individual_updates, FULL.population_updates, FULL.replay_rows) == (1000, 250, 6_500_000)
