"""What a machine has, and what follows from what it lacks."""

from __future__ import annotations

import configparser
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from coim import products
from coim.experiments.commands import check


def test_every_part_of_this_machine_has_a_line(capsys: pytest.CaptureFixture) -> None:
    check.main([])
    said = capsys.readouterr().out
    found = dict(line.split(maxsplit=1) for line in said.split("\n\n")[0].splitlines())
    assert {"python", "coim", "ray", "processor", "products", "GPU", "compiler", "OpenGL", "disk"} <= found.keys()
    assert found["torch"] == torch.__version__
    assert found["mujoco"].split(".")[0] >= "3"


def test_a_missing_package_names_what_is_lost_and_the_way_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(check, "OPTIONAL", {"no-such-package": ("no studies", "'coim[experiments]'")})
    finding = check.versions()[-1]
    assert finding.found == "not installed"
    assert finding.lack == "no studies without no-such-package: pip install 'coim[experiments]'"


def test_every_optional_package_is_one_of_the_extra_that_is_named_for_it() -> None:
    """trackio is in none: it wants an older pillow than the rest."""
    setup = configparser.ConfigParser()
    setup.read(Path(__file__).parents[3] / "setup.cfg")
    extras = {name: packages.split() for name, packages in setup["options.extras_require"].items()}
    for package, (_, by) in check.OPTIONAL.items():
        assert by == package or package in extras[by.removeprefix("'coim[").removesuffix("]'")]


def test_a_processor_without_bfloat16_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (check, products):
        monkeypatch.setattr(module, "has_bfloat16", lambda: False)
    assert "bfloat16 emulated" in check.products().found
    assert "--precision float32 is faster" in check.products().lack


def test_one_core_a_missing_compiler_and_a_full_disk_are_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(check, "available_cores", lambda: 1)
    assert "the learners take turns" in check.processor().lack
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert "no C++ compiler (no-such-compiler) was found" in check.compiler().lack
    monkeypatch.setattr(check.shutil, "disk_usage", lambda path: SimpleNamespace(free=1e9))
    assert check.room().lack.startswith("1.0 GB of disk")


def test_opengl_that_does_not_draw_is_a_lack(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(check, "DRAW", "raise RuntimeError('no library of that name')")
    finding = check.opengl()
    assert finding.found.startswith("does not draw")
    assert finding.lack == "no films and no drawn bodies: no library of that name"
