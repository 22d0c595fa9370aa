"""A release says the same everywhere: its version, its title and the paper that it implements."""

from __future__ import annotations

import re
from configparser import ConfigParser
from pathlib import Path

import coim

ROOT = Path(__file__).parents[1]
CITATION, README, CHANGELOG = ((ROOT / name).read_text() for name in ("CITATION.cff", "README.md", "CHANGELOG.md"))


def found(pattern: str, text: str) -> str:
    match = re.search(pattern, text, re.MULTILINE)
    assert match is not None, f"{pattern} is nowhere"
    return match[1]


def test_all_files_have_one_version() -> None:
    setup = ConfigParser()
    setup.read(ROOT / "setup.cfg")
    assert {
        "setup.cfg": setup["metadata"]["version"],
        "CITATION.cff": found(r"^version: (\S+)$", CITATION),
        "CHANGELOG.md, its first released section": found(r"^## (\d\S*) ", CHANGELOG),
        "BibTeX in README.md": found(r"version = \{(.*?)\}", README),
    } == dict.fromkeys(
        ("setup.cfg", "CITATION.cff", "CHANGELOG.md, its first released section", "BibTeX in README.md"),
        coim.__version__,
    )


def test_the_citation_and_the_changelog_have_one_date() -> None:
    assert found(r'^date-released: "(\S+)"$', CITATION) == found(r"^## \d\S* \((\S+)\)$", CHANGELOG)


def test_bibtex_and_citation_name_the_same_works() -> None:
    software, paper = re.findall(r"title: (.*)$", CITATION.replace('"', ""), re.MULTILINE)[:2]
    bibtex = README[README.index("```bibtex") :]
    titles = re.findall(r"^  title = \{(.*)\},$", bibtex.replace("{{", "{").replace("}}", "}"), re.MULTILINE)
    assert titles == [software, paper]
    families = re.findall(r"family-names: (\w+)", CITATION)
    authors = found(r"author = \{(Sliacka.*)\}", bibtex)
    assert [name.split(",")[0] for name in authors.split(" and ")] == families
