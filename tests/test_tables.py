"""CSV files that were saved again by something else, edited, or are still being written."""

from __future__ import annotations

import ast
import dataclasses
import math
from pathlib import Path

import pytest

from coim.tables import Layout, read_columns, read_table

LAYOUT = Layout(
    file="table.csv",
    columns={"run": int, "kind": str, "xi_": float, "return": float, "seconds": float, "diverged": str},
    needed=("run", "kind", "return"),
)
TEXT = "run,kind,xi_torso,return\n0,first,0.5,1.25\n1,random,2,\n"
TABLE = {
    "run": [0, 1],
    "kind": ["first", "random"],
    "xi_torso": [0.5, 2.0],
    "return": [1.25, math.nan],
    "seconds": [math.nan, math.nan],  # which the file does not have
    "diverged": ["", ""],
}
ROOT = Path(__file__).parents[1]


def written(folder: Path, contents: str | bytes) -> Path:
    path = folder / "table.csv"
    path.write_bytes(contents.encode() if isinstance(contents, str) else contents)
    return path


@pytest.mark.parametrize(
    "contents",
    [
        TEXT,
        "\ufeff" + TEXT,
        TEXT.replace("\n", "\r\n"),
        TEXT.replace("\n", "\r"),
        TEXT.replace("first", '"first"').replace("0.5", '"0.5"'),
        TEXT + "\n\n",
        TEXT + "1,rand",
        TEXT + '0,first,0.5,"1',
    ],
    ids=["as written", "BOM", "Windows", "old Macintosh", "quoted", "empty lines", "being written", "in a quoted cell"],
)
def test_what_means_the_same_is_read_the_same(tmp_path: Path, contents: str) -> None:
    path = written(tmp_path, contents)
    assert str(read_table(path, LAYOUT)) == str(TABLE)  # NaN is not equal to itself
    assert read_columns(path) == ["run", "kind", "xi_torso", "return"]


@pytest.mark.parametrize("contents", ["", "run,kind,xi_torso,return\n", "run,ki"])
def test_a_file_that_is_not_there_or_empty_has_no_rows(tmp_path: Path, contents: str) -> None:
    for table in (read_table(tmp_path / "none.csv", LAYOUT), read_table(written(tmp_path, contents), LAYOUT)):
        assert {"run", "kind", "return", "seconds", "diverged"} <= table.keys()
        assert not any(table.values())


@pytest.mark.parametrize(
    ("contents", "line", "found", "expected"),
    [
        (TEXT.replace(",", ";"), 1, "run;kind;xi_torso;return", "columns run,kind,return"),
        (TEXT.replace(",", "\t"), 1, "run\tkind\txi_torso\treturn", "columns run,kind,return"),
        (TEXT.replace(".", ","), 2, "6 cells", "4 as in line 1"),
        (TEXT.replace("1.25", '"1,25"'), 2, "'1,25' in column return", "a number or nothing"),
        (TEXT.replace("1.25", "abc"), 2, "'abc' in column return", "a number or nothing"),
        (TEXT.replace("2,\n", ",\n"), 3, "'' in column xi_torso", "a number"),
        (TEXT.replace("0.5", "nan"), 2, "'nan' in column xi_torso", "a finite number"),
        (TEXT.replace("1,random", "1.0,random"), 3, "'1.0' in column run", "a whole number"),
        (TEXT.replace("0,first,0.5,1.25", "0,first,0.5"), 2, "3 cells", "4 as in line 1"),
        (TEXT.replace("return", "reward"), 1, "run,kind,xi_torso,reward", "columns run,kind,return"),
        (TEXT.replace("first", '"first'), 3, "unexpected end of data", "4 cells"),
        (TEXT.replace("first", "f\xfcrst").encode("latin-1"), 2, "the byte 0xfc", "text in UTF-8"),
        (TEXT.encode("utf-16"), 1, "the byte 0xff", "text in UTF-8"),
    ],
    ids=lambda value: value if isinstance(value, str) and "\n" not in value else "",
)
def test_what_does_not_is_refused_by_its_line(
    tmp_path: Path, contents: str | bytes, line: int, found: str, expected: str
) -> None:
    path = written(tmp_path, contents)
    with pytest.raises(ValueError, match="put the file back from a copy, or save it again in UTF-8") as refusal:
        read_table(path, LAYOUT)
    assert str(refusal.value).startswith(f"{path}, line {line}: found {found}, expected {expected}; ")
    assert "\n" not in str(refusal.value)


def test_of_a_file_that_does_not_grow_the_last_line_counts_without_its_end(tmp_path: Path) -> None:
    path = written(tmp_path, TEXT.removesuffix("\n"))
    assert read_table(path, LAYOUT)["run"] == [0]
    assert str(read_table(path, dataclasses.replace(LAYOUT, grows=False))) == str(TABLE)


def test_a_float_is_read_as_it_was_written(tmp_path: Path) -> None:
    values = [0.1 + 0.2, 1e-320, math.nextafter(1.0, 2.0), 123456789.123456789]
    path = written(tmp_path, TEXT.splitlines()[0] + "\n" + "".join(f"0,first,1,{value!r}\n" for value in values))
    assert read_table(path, LAYOUT)["return"] == values


def test_nothing_else_reads_csv_files() -> None:
    sources = [path for folder in ("coim", "recipes", "benchmarks") for path in (ROOT / folder).rglob("*.py")]
    calls = [
        path.relative_to(ROOT).as_posix()
        for path in sources
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Attribute) and ast.unparse(node) in ("csv.reader", "csv.DictReader", "pd.read_csv")
    ]
    assert {*calls} == {"coim/tables.py"}
