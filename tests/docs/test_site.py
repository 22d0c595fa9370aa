"""What the site is made of: every public name, times that were measured, and links that lead somewhere."""

from __future__ import annotations

import csv
import json
import re
import runpy
from pathlib import Path

import pytest

import coim

DOCS = Path(__file__).parents[2] / "docs"
REFERENCE = "\n".join(path.read_text() for path in sorted((DOCS / "api").glob("*.rst")))
broken_links = runpy.run_path(str(DOCS / "links.py"))["broken_links"]


def test_every_public_name_is_in_the_reference_once() -> None:
    """A new name of `coim.__all__` belongs into a page of docs/api."""
    names = re.findall(r"^   coim\.(\w+)$", REFERENCE, re.MULTILINE)
    assert sorted(names) == sorted([*coim.__all__, "experiments"])


def test_the_modules_of_the_experiments_are_in_the_reference() -> None:
    """Sphinx finds them by itself, whatever their number."""
    assert ":recursive:\n\n   coim.experiments\n" in REFERENCE


def test_every_page_is_in_a_table_of_contents() -> None:
    index = (DOCS / "index.md").read_text()
    listed = {line for line in index.splitlines() if re.fullmatch(r"[\w/]+", line)}
    assert {path.stem for path in DOCS.glob("*.md")} - {"index"} <= listed
    pages = {path.stem for path in (DOCS / "api").glob("*.rst")} - {"index"}
    assert pages == set(re.findall(r"^   (\w+)$", (DOCS / "api" / "index.rst").read_text(), re.MULTILINE))


def test_every_page_of_results_is_listed() -> None:
    patterns = re.findall(r"^results/.*$", (DOCS / "results.md").read_text(), re.MULTILINE)
    pages = [Path("/") / path.relative_to(DOCS).with_suffix("") for path in (DOCS / "results").rglob("*.md")]
    assert len(pages) > 5
    assert [page for page in pages if not any(page.match(f"/{p}") for p in patterns)] == []


def test_parts_of_other_files_are_where_pages_look_for_them() -> None:
    found = 0
    for page in DOCS.glob("*.md"):
        for name, options in re.findall(r"```\{include\} (\S+)\n(.*?)```", page.read_text(), re.DOTALL):
            text = (DOCS / name).read_text()
            marks = re.findall(r'^:(?:start-after|end-before): "(.*)"$', options, re.MULTILINE)
            assert [text.count(f"{mark}\n") for mark in marks] == [1] * len(marks), (page.name, marks)
            found += 1
    assert found == 4


def test_the_times_of_the_hardware_page_were_measured() -> None:
    measured = {}
    for figure in json.loads((DOCS / "results" / "benchmarks.json").read_text())["figures"]:
        measured.setdefault(figure["row"], figure["amount"]["median"])
    table, on_gpu = (DOCS / "hardware.md").read_text().split("| row | median |")[1].split("## On a GPU")
    told = re.findall(r"^\| (.*) \| ([\d.,]+) [\w/ ]+ \|$", table, re.MULTILINE)
    assert len(told) == 17
    assert {row: float(amount.replace(",", "")) for row, amount in told} == {
        row: pytest.approx(measured[row], rel=5e-3) for row, _ in told
    }
    with (DOCS / "results" / "gpu.csv").open() as file:
        rows = {(row["runs"], row["units"], row["products"]): float(row["update_ms"]) for row in csv.DictReader(file)}
    told = re.findall(
        r"^\| (\d+), 3 x (\d+)(?:, .*?(TF32|bfloat16)`?)? \| ([\d.]+) ms \|.* \| ([\d.]+) ms \|$", on_gpu, re.MULTILINE
    )
    assert len(told) == 8
    for runs, units, products, update, each in told:
        found = rows[runs, units, products.lower() or "float32"]
        assert (float(update), float(each)) == (
            pytest.approx(found, abs=5e-3),
            pytest.approx(found / int(runs), rel=0.03),
        )


def write_site(folder: Path, **pages: str) -> Path:
    for name, text in pages.items():
        (folder / f"{name}.html").write_text(text)
    return folder


def test_links_that_lead_somewhere_are_let_through(tmp_path: Path) -> None:
    (tmp_path / "a b.csv").write_text("")
    one = '<p id="top"><a href="#top"></a><a href="two.html#x%20y"></a><a href="a%20b.csv"></a>'
    one += '<a href="https://no.where/"></a>'
    assert broken_links(write_site(tmp_path, one=one, two='<h1 id="x y"></h1><img src="a%20b.csv">')) == []


@pytest.mark.parametrize(
    ("link", "complaint"),
    [
        ('<a href="three.html">', "one.html: three.html leads to no file"),
        ('<img src="a.png">', "one.html: a.png leads to no file"),
        ('<a href="two.html#there">', "one.html: two.html#there leads to no place in its page"),
        ('<a href="#here">', "one.html: #here leads to no place in its page"),
    ],
)
def test_a_broken_link_is_found(tmp_path: Path, link: str, complaint: str) -> None:
    assert broken_links(write_site(tmp_path, one=link, two="")) == [complaint]


def test_a_folder_without_pages_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="has no page; build the site with make docs"):
        broken_links(tmp_path)
