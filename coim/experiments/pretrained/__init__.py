"""Trained robots that come with the package: for each a policy, its body, and a card that says how it was made.

``NAME.safetensors`` and ``NAME.json`` are files of ``coim export``, ``NAME.md`` is the card.
"""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).parent


def names() -> list[str]:
    """Names of the robots that there are.

    Example:
        >>> "hopper" in names()
        True
    """
    return sorted(path.stem for path in FOLDER.glob("*.safetensors"))


def policy_file(name: str | None) -> Path:
    """The policy of a robot, for `coim.experiments.export.taken.take` or ``coim evaluate``.

    Raises:
        ValueError: if there is none of this name; those that there are, are named.

    Example:
        >>> policy_file("hopper").name
        'hopper.safetensors'
        >>> policy_file("ostrich")
        Traceback (most recent call last):
        ValueError: --pretrained is 'ostrich': there are ...hopper...
    """
    if name not in names():
        raise ValueError(f"--pretrained is {name!r}: there are {', '.join(names())}")
    return FOLDER / f"{name}.safetensors"
