"""The measurement of imagined rows at sizes of seconds: that it can be made, and what must hold at any size."""

from __future__ import annotations

import csv
from pathlib import Path

from benchmarks.imagined_rows import Measurement, main


def test_tables_of_the_measurement(tmp_path: Path) -> None:
    main(
        Measurement(
            out=tmp_path, seeds=(0,), designs=2, updates=10, rows=60, episode_steps=20, model_cells=(8,), num_bodies=2
        )
    )
    found = {path.stem: list(csv.DictReader(path.read_text().splitlines())) for path in tmp_path.glob("*.csv")}
    assert {name: len(rows) for name, rows in found.items()} == {"foreseen": 2, "rows": 18, "floor": 6}
    for row in found["rows"]:
        assert row["way"] == "as printed" or float(row["impossible"]) == 0
        if (row["designs"], row["way"], row["actions"]) == ("known", "matched, anchored", "replayed"):
            assert float(row["drawn"]) < 1e-3  # the real transition, up to what float32 observations lose
    assert all(float(row["weights drawn anew"]) > 0.9 for row in found["foreseen"])
