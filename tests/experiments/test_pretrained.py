"""The trained robots of the package: each is whole, and earns what its card says."""

from __future__ import annotations

import re

import pytest

from coim.experiments.export.evaluation import evaluate
from coim.experiments.export.taken import take
from coim.experiments.pretrained import FOLDER, names, policy_file

EPISODES = 5


def test_the_package_has_a_policy_a_body_and_a_card_of_each() -> None:
    assert "hopper" in names()
    files = {f"{name}.{suffix}" for name in names() for suffix in ("safetensors", "json", "md")}
    assert {path.name for path in FOLDER.iterdir() if path.suffix != ".py" and path.is_file()} == files
    assert all(policy_file(name).stat().st_size < 500_000 for name in names())


@pytest.mark.parametrize("name", names())
def test_a_trained_robot_earns_what_its_card_says(name: str) -> None:
    pytest.importorskip("safetensors")
    card = (FOLDER / f"{name}.md").read_text()
    found = re.search(r"return \| ([\d.]+) ± ([\d.]+)", card)
    assert found is not None
    mean, deviation = float(found[1]), float(found[2])
    taken = take(policy_file(name), "best", run=None, policy=None, body=None)
    returns = evaluate(taken, episodes=EPISODES, seed=1)["return"]  # other starts than those of the card
    # Three standard errors, and a twentieth for another processor's rounding. An episode in which a robot falls, as the
    # walker does in one of two hundred, would move their mean by more.
    assert abs(returns.median() - mean) < 3 * deviation / EPISODES**0.5 + mean / 20
