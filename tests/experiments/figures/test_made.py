"""What a page of figures says of how its runs were made."""

from __future__ import annotations

from pathlib import Path

from coim.experiments.figures.made import made_otherwise
from tests.experiments.made_up_study import write_cell


def test_settings_in_which_runs_differ_that_are_compared_are_named(tmp_path: Path) -> None:
    write_cell(tmp_path, "hopper-forward-none-0", [1, 2, 3, 4], imagine="none", seed=0)
    write_cell(tmp_path, "hopper-forward-known-0", [1, 2, 3, 4], seed=0)
    write_cell(tmp_path, "walker-forward-known-0", [1, 2, 3, 4], seed=0, gamma=0.5)  # a body of its own
    assert made_otherwise(tmp_path) == []  # arms differ in what they are about
    write_cell(tmp_path, "hopper-forward-known-1", [1, 2, 3, 4], seed=1, gamma=0.99, imagine="noisy")
    assert made_otherwise(tmp_path) == [
        "**Runs with different settings are compared: `gamma` of hopper, forward (0.9 in 2, 0.99 in 1); `imagine` of "
        "hopper, forward, known (known in 1, noisy in 1).**",
        "",
    ]
