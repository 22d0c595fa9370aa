"""Docstrings and errors are in plain English, as far as a program can tell."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = [path for folder in ("coim", "recipes", "benchmarks") for path in sorted((ROOT / folder).rglob("*.py"))]
RIDDLES = re.compile(r"(Of|Whose|Who|What it is that)\b")
EXCEPTION = re.compile(r"\{?(\w*Error|\w*Exception|type\((error|exception|e)\)\.__name__)\b")


def complaints(source: str) -> list[str]:
    """Docstrings that begin like a riddle, and errors that begin with the name of an exception."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            docstring = ast.get_docstring(node) or ""
            if RIDDLES.match(docstring):
                found.append(f"begins like a riddle: {docstring.splitlines()[0]}")
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args:
            message = ast.unparse(node.exc.args[0]).lstrip("rf").lstrip("'\"")
            if EXCEPTION.match(message):
                found.append(f"begins with an exception's name: {message}")
    return found


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_docstrings_and_errors_begin_plainly(path: Path) -> None:
    assert complaints(path.read_text()) == []


@pytest.mark.parametrize(
    "source",
    [
        '"""Of the ones that are possible."""',
        'class Body:\n    """Who walks."""',
        'def f():\n    """Whose rows these are."""',
        'raise ValueError("ValueError: no rows")',
        'raise RuntimeError(f"{type(error).__name__}: {error}")',
    ],
)
def test_a_riddle_is_found(source: str) -> None:
    assert len(complaints(source)) == 1


def test_plain_words_are_let_through() -> None:
    assert complaints('"""Offset of a body."""\nraise ValueError(f"{name} is wrong")') == []
