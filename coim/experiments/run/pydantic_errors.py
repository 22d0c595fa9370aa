"""Errors of pydantic in one sentence each, with the value, the bound and the way out."""

from __future__ import annotations

import dataclasses
import functools
import re
import reprlib
from collections.abc import Callable
from difflib import get_close_matches
from typing import Any, TypeVar, get_args, get_type_hints

from pydantic import ConfigDict, ValidationError

from coim.run_folder import RENAMED

Owner = TypeVar("Owner")

# Numbers are no strings, no field is unknown, and no number is infinite.
CONFIG = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
# The end of "NAME is VALUE, it must be ..." for each kind of error that our types can have.
MUST_BE = {
    "int_type": "a whole number",
    "float_type": "a finite number",
    "finite_number": "a finite number",
    "bool_type": "true or false",
    "string_type": "a string",
    "is_instance_of": "a {class}",
    "tuple_type": "a list",
    "mapping_type": "a mapping of names to values",
    "dict_type": "a mapping of names to values",
    "dataclass_type": "a mapping of names to values",
    "dataclass_exact_type": "a {class_name}",
    "literal_error": "{expected}",
    "greater_than_equal": "at least {ge:g}",
    "greater_than": "above {gt:g}",
    "less_than_equal": "at most {le:g}",
}


def refused_in_words(owner: type[Owner]) -> type[Owner]:
    """Let a pydantic dataclass raise a ValueError of one sentence, with pydantic's own error as its cause.

    Example:
        >>> from coim.experiments.run.settings import Settings
        >>> Settings(episodes=0)
        Traceback (most recent call last):
        ValueError: episodes is 0, it must be at least 1
    """
    validated = owner.__init__

    @functools.wraps(validated)
    def init(self: Owner, *args: Any, **values: Any) -> None:
        try:
            validated(self, *args, **values)
        except ValidationError as error:
            raise ValueError(sentence(error, type(self))) from error

    owner.__init__ = init  # type: ignore[assignment, method-assign]
    return owner


def sentence(error: ValidationError, owner: type[Any], *, called: Callable[[str], str] = str) -> str:
    """The first complaint of pydantic in words.

    Args:
        error: pydantic's.
        owner: the dataclass that was to be made.
        called: from a field's name to its name where somebody wrote it, such as an option of a command line.
    """
    found = error.errors(include_url=False)
    unknown = [one for one in found if one["type"] in ("unexpected_keyword_argument", "extra_forbidden")]
    missing = [one for one in found if one["type"].startswith("missing")]
    first, *_ = unknown or missing or found  # a name with a typing error is unknown, and missing under its right name
    where, path = "", first["loc"]
    while len(path) > 2 and isinstance(path[1], int) and isinstance(path[2], str):  # in one entry of a list
        where += f"in {str(path[0]).removesuffix('s')} {path[1] + 1}: "
        owner = get_args(get_type_hints(owner)[str(path[0])])[0]
        path = path[2:]
    name = called(str(path[0])) if path else "it"
    if unknown:
        return f"{where}there is no {name}; {_other_names(str(path[0]), owner, called)}"
    if missing:
        beside = [one["loc"][-1] for one in missing if one["loc"][:-1] == first["loc"][:-1]]
        return f"{where}it has no {', '.join(map(str, beside))}; add what is missing"
    if first["type"] == "value_error":  # by a function of ours, with names of fields in backticks
        return where + re.sub("`(.*?)`", lambda quoted: called(quoted[1]), str(first["ctx"]["error"]))
    value, entry = reprlib.repr(first["input"]), len(path) > 1
    if first["type"] == "too_short":
        return f"{where}{name} is empty; name at least one entry"
    if first["type"] not in MUST_BE:  # such as a file that is no JSON
        return where + first["msg"]
    must_be = MUST_BE[first["type"]].format(**first.get("ctx", {}))
    return f"{where}{name} {'has' if entry else 'is'} {value}, {'each' if entry else 'it'} must be {must_be}"


def _other_names(unknown: str, owner: type[Any], called: Callable[[str], str]) -> str:
    """The way out of an unknown name: its name of today, the fields with a similar name, or all fields."""
    fields = [field.name for field in dataclasses.fields(owner)]
    if RENAMED.get(unknown) in fields:
        return f"it is called {called(RENAMED[unknown])} now"
    if similar := get_close_matches(unknown, fields):
        return f"similar names are {', '.join(map(called, similar))}"
    return f"there are {', '.join(map(called, fields))}"
