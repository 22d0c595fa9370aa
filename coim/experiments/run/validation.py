"""Values that people write, held against what they must be: the kind of an annotation, and an interval."""

from __future__ import annotations

import dataclasses
import functools
import math
import reprlib
from collections.abc import Mapping
from typing import Any, Literal, get_args, get_origin, get_type_hints

# One of a kind, and many, in the words of an error.
WORDS: dict[Any, tuple[str, str]] = {
    int: ("a whole number", "whole numbers"),
    float: ("a finite number", "finite numbers"),
    bool: ("true or false", "true or false"),
    str: ("a string", "strings"),
    Mapping: ("a mapping of names to values", "mappings of names to values"),
}


@dataclasses.dataclass(frozen=True)
class Interval:
    """Numbers that are allowed.

    Attributes:
        low: the lowest of them.
        high: the highest of them.
        above: whether ``low`` itself is too low.

    Example:
        >>> 0 in Interval(0, 1), 0 in Interval(0, 1, above=True)
        (True, False)
        >>> [str(allowed) for allowed in (Interval(1), Interval(0, 1), Interval(0, above=True))]
        ['be at least 1', 'lie in [0, 1]', 'be above 0']
    """

    low: float
    high: float = math.inf
    above: bool = False

    def __contains__(self, number: float) -> bool:
        return (self.low < number if self.above else self.low <= number) and number <= self.high

    def __str__(self) -> str:
        if self.high < math.inf:
            return f"lie in {'(' if self.above else '['}{self.low}, {self.high}]"
        return f"be {'above' if self.above else 'at least'} {self.low}"


@functools.cache
def kinds_of(owner: type[Any]) -> dict[str, Any]:
    """The annotation of each field of a dataclass by the field's name."""
    return get_type_hints(owner)


def fitted(name: str, value: object, kind: Any) -> Any:
    """A value as an annotation has it.

    Lists, as JSON has them, become tuples, and whole numbers become floats where those are asked for.

    Args:
        name: what the value is called where it was written.
        value: whatever was written there.
        kind: a class, ``Literal[...]`` of strings, ``tuple[..., ...]`` or ``Mapping[...]``.

    Raises:
        ValueError: if it is of another kind.

    Example:
        >>> fitted("num_cells", [8, 8], tuple[int, ...])
        (8, 8)
        >>> fitted("episodes", "20", int)
        Traceback (most recent call last):
        ValueError: episodes is '20', it must be a whole number
    """
    try:
        return _as(kind, value)
    except (TypeError, OverflowError):
        raise ValueError(f"{name} is {reprlib.repr(value)}, it must be {in_words(kind)}") from None


def refuse_outside(name: str, value: Any, allowed: Interval) -> None:
    """Refuse a number that is not allowed, or a tuple that has one.

    Raises:
        ValueError: with the value and what is allowed.
    """
    entries = value if isinstance(value, tuple) else (value,)
    if not all(entry in allowed for entry in entries):
        raise ValueError(f"{name} is {value}, {'each' if entries is value else 'it'} must {allowed}")


def in_words(kind: Any) -> str:
    """What a value of this kind is, as an error says it."""
    if get_origin(kind) is Literal:
        return f"one of {', '.join(get_args(kind))}"
    if get_origin(kind) is tuple:
        return f"a list of {_words(get_args(kind)[0])[1]}"
    return _words(kind)[0]


def _words(kind: Any) -> tuple[str, str]:
    name = getattr(kind, "__name__", str(kind))
    return WORDS.get(get_origin(kind) or kind, (name, name))


def _as(kind: Any, value: Any) -> Any:
    """A value as `fitted` returns it; TypeError if it is of another kind."""
    origin, among = get_origin(kind), get_args(kind)
    if origin is tuple:
        if isinstance(value, list | tuple):
            return tuple(_as(among[0], entry) for entry in value)
    elif origin is Literal:
        if value in among:
            return value
    elif kind is bool or not isinstance(value, bool):  # which Python counts among the whole numbers
        if kind is float and isinstance(value, int | float) and math.isfinite(value):
            return float(value)
        if kind is not float and isinstance(value, Mapping if origin is Mapping else kind):
            return value
    raise TypeError
