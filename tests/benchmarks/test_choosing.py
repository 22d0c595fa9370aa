"""Simulated studies of ways to choose bodies: the surfaces, one study, the tables; and stored runs replayed."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
import torch

from benchmarks import choosing, replay
from benchmarks.choosing import Arm, study, summary
from benchmarks.surfaces import Tried, made_up_critic, pooled, stored, uniform
from coim.designs import posterior


def test_the_pooled_surface_is_the_quadratic_that_returns_were_made_of() -> None:
    rng = torch.Generator().manual_seed(0)
    spec = pooled(stored("hopper")).spec
    designs = uniform(spec, 300, rng)

    def truth(x: torch.Tensor) -> torch.Tensor:
        return 1000 + 200 * x[:, 0] - 150 * x[:, 1] ** 2 + 80 * x[:, 2] * x[:, 3]

    # From the first of 15 designs to the last 300 more, and 0 in the middle.
    tried = [
        Tried("hopper-0", n % 15 + 1, "random", design, float(worth + 300 * ((n % 15 + 1) / 15 - 0.5)))
        for n, (design, worth) in enumerate(zip(designs, truth(designs)))
    ]
    surface = pooled(tried)
    assert surface.trend == pytest.approx(300, rel=0.15)
    others = uniform(spec, 1000, rng)
    error = surface.truth(others) - truth(others)
    # The ridge draws a little towards 0.
    assert error.mean().abs() < 20
    assert error.std() < 0.12 * truth(others).std()


def test_a_made_up_critic_correlates_with_the_truth_as_it_shall() -> None:
    surface = choosing.SURFACES["hopper"]()
    box = uniform(surface.spec, 20_000, torch.Generator().manual_seed(7))
    for correlation in (-0.45, 0.0, 0.5):
        values = made_up_critic(surface, correlation, seed=3)(box)
        assert torch.corrcoef(torch.stack([values, surface.truth(box)]))[0, 1] == pytest.approx(correlation, abs=0.03)


def test_a_critic_that_is_the_truth_chooses_the_best_body_each_time() -> None:
    surface = choosing.SURFACES["hopper"]()
    worth = surface.truth(surface.box())
    found = study(Arm(name="critic alone", choose="critic", critic=1.0, designs=8), surface, seed=0)
    assert found.gain > 0.95 * float(worth.max() - worth.mean())
    assert abs(found.explored) < 3 * float(worth.std())


@pytest.mark.parametrize(
    "options", [{}, {"choose": "improvement"}, {"explore": "uncertain"}, {"reach": 0.1}, {"spread": 1.0}]
)
def test_a_study_is_the_same_again_and_leaves_the_constants_of_the_library(options: dict[str, object]) -> None:
    surface, spread = choosing.SURFACES["hopper"](), posterior.SPREAD
    arm = Arm(name="any", designs=8, critic=0.5, **options)
    first = study(arm, surface, seed=1)
    assert first == study(arm, surface, seed=1)
    assert 0 <= first.covered_chosen <= 1
    assert spread == posterior.SPREAD


def test_the_summary_has_means_intervals_and_what_is_gained_more_seed_by_seed() -> None:
    shared = {"surface": "hopper", "critic": "None", "designs": "15", "last": "5", "explored": "-3"}
    shared |= {"covered_chosen": "0.8", "covered_explored": "1", "listened": "0"}
    gains = {"posterior": ("100", "300"), "optimism 2": ("160", "380")}
    rows = [shared | {"arm": arm, "seed": str(n), "gain": gain} for arm in gains for n, gain in enumerate(gains[arm])]
    plain, other = summary(rows)
    # The deviation of 100 and 300 is 141.4: 12.706 x 141.4 / sqrt(2) = 1271. That of 60 and 80 is 14.14.
    assert [plain[name] for name in ("gain", "gain_low", "gain_high", "more", "studies")] == [
        "200",
        "-1071",
        "1471",
        "0",
        "2",
    ]
    assert [other[name] for name in ("more", "more_low", "more_high")] == ["70", "-57", "197"]
    assert (other["last"], other["covered_chosen"]) == ("5", "0.80")


def test_the_same_line_again_goes_on_and_changes_no_row(tmp_path: Path) -> None:
    choosing.main(choosing.Asked(tmp_path, studies=1, arms=1))
    before = (tmp_path / "studies.csv").read_text()
    choosing.main(choosing.Asked(tmp_path, studies=2, arms=1))
    after = (tmp_path / "studies.csv").read_text()
    assert after.startswith(before)
    assert len(after.splitlines()) == 3


def test_a_replayed_run_has_its_own_returns_and_what_other_seeds_say_of_both_choices(tmp_path: Path) -> None:
    replay.main(replay.Asked(tmp_path, runs=1))
    rows = list(csv.DictReader((tmp_path / "replay.csv").read_text().splitlines()))
    assert [row["design"] for row in rows if row["run"] == "hopper-forward-known-0"] == [str(n) for n in range(4, 16)]
    own = [one.returned for one in stored("hopper") if one.run == "hopper-forward-known-0"]
    assert [float(row["best_return"]) for row in rows[:12]] == pytest.approx(own[3:], rel=1e-5)
    judged = [row for row in rows if row["eq5_gain"]]
    assert [row["kind"] for row in judged] == ["optimised"] * 5
    assert all(float(row["posterior_gain"]) > float(row["eq5_gain"]) for row in judged)
