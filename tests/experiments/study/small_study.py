"""A study of four small cells."""

from __future__ import annotations

from coim.experiments.study.definition import Study


def study(**fields: object) -> Study:
    least = {"name": "s", "environments": ("hopper",), "arms": ("none", "known"), "seeds": (3, 4), "protocol": "smoke"}
    return Study(**{**least, **fields})
