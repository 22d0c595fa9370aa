"""What Eq. 5 is worth with stored and with matched states, on trained networks."""

from __future__ import annotations

import csv
from pathlib import Path

from benchmarks.value_states import Asked, main


def test_matched_start_states_take_away_the_wrong_order(tmp_path: Path) -> None:
    main(Asked(out=tmp_path / "table.csv", draws=1, num_states=(36,), episode_steps=50))
    rows = list(csv.DictReader((tmp_path / "table.csv").read_text().splitlines()))
    found = {(row["over"], row["states"]): float(row["correlation"]) for row in rows}
    assert found.keys() == {(over, how) for over in ("start", "visited") for how in ("stored", "matched")}
    assert found["start", "stored"] < -0.3
    assert -0.2 < found["start", "matched"] < 0.2
