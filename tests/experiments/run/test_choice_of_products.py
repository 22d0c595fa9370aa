"""Which library multiplies in a run: it is told, written down, and kept when the run goes on."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from interrupted_runs import cut
from tiny_runs import resume, run

from coim import HopperMorph, products
from coim.experiments.run.machine import choose_products, keep_freed_memory
from coim.experiments.train import main
from coim.products import Choice

NARROW = Choice("torch", "emulated")  # every machine can


@pytest.fixture(autouse=True)
def choice_put_back() -> Iterator[None]:
    before = products.chosen()
    yield
    products.use(before)


def config_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "config.json").read_text())


def begun_with(folder: Path, choice: dict[str, str]) -> Path:
    """A run that another machine began."""
    (cut(folder, 6) / "config.json").write_text(json.dumps(config_of(folder) | {"products": choice}))
    return folder


@pytest.mark.usefixtures("undrawn")
def test_a_run_tells_and_notes_which_library_multiplies(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(products, "has_bfloat16", lambda: False)
    run(tmp_path / "run", products="torch", precision="bfloat16", quiet=False, num_designs=1, page=True)
    first, second = capsys.readouterr().out.splitlines()[:2]
    assert first.endswith(f"not compiled, products by torch, bfloat16 emulated -> {tmp_path / 'run'}")
    assert second == "bfloat16 is emulated by float32 products here, which is slower than --precision float32"
    config = config_of(tmp_path / "run")
    assert config["products"] == {"float32": "torch", "bfloat16": "emulated"}
    assert config["settings"]["products"] == "torch"
    assert "products in bfloat16" in (tmp_path / "run" / "report.html").read_text()


def test_a_run_that_goes_on_keeps_its_products_and_says_where_others_would_be_taken(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(products, "fastest", lambda: Choice("torch", "torch"))
    monkeypatch.setattr(products, "has_bfloat16", lambda: True)
    folder = begun_with(tmp_path / "run", NARROW._asdict())
    resume(folder, "--num-designs", "4")
    assert (
        "products stay by torch, bfloat16 emulated, as the run began; a new one would take torch here; the numbers"
        in (capsys.readouterr().err)
    )
    assert products.chosen() == NARROW
    (entry,) = config_of(folder)["resumed"]
    assert entry["products"] == config_of(folder)["products"] == NARROW._asdict()


def test_other_products_are_taken_when_they_are_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder = begun_with(tmp_path / "run", {"float32": "onednn", "bfloat16": "onednn"})
    resume(folder, "--products", "torch")
    assert "products were by onednn and are by torch" in capsys.readouterr().err
    config = config_of(folder)
    assert config["resumed"][0]["changed"] == {"products": ["auto", "torch"]}
    assert config["products"] == products.chosen()._asdict()
    assert products.chosen().float32 == "torch"


def test_products_that_this_machine_lacks_are_replaced_with_a_warning(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(products, "_LINEAR", None)
    here = choose_products("auto", begun={"float32": "onednn", "bfloat16": "emulated"})
    assert here == products.chosen() == products.fastest()
    told = capsys.readouterr().err
    assert "products were by onednn, bfloat16 emulated and are by torch" in told
    assert "this build of torch has no oneDNN" in told


def test_nothing_is_said_of_products_that_stay(capsys: pytest.CaptureFixture) -> None:
    assert choose_products("auto", begun=products.fastest()._asdict()) == products.fastest()
    assert capsys.readouterr() == ("", "")


def test_a_run_that_is_refused_leaves_the_products_of_this_process_alone(tmp_path: Path) -> None:
    folder = cut(tmp_path / "run", 1)
    (folder / "config.json").write_text((folder / "config.json").read_text().replace('"hopper"', '"walker"'))
    products.use(NARROW)
    with pytest.raises(SystemExit, match="holds a run of walker"):
        resume(folder, "--products", "torch")
    assert products.chosen() == NARROW


def test_a_library_that_is_not_here_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(products, "_LINEAR", None)
    with pytest.raises(SystemExit, match="no oneDNN; choose products 'torch' or 'auto'"):
        main(HopperMorph, "hopper", ["--products", "onednn", "--out", str(tmp_path / "run")])
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("error", [ImportError, OSError, AttributeError, TypeError])
def test_without_an_allocator_that_can_be_told_nothing_is_told(
    monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    def missing(name: object) -> None:
        raise error

    monkeypatch.setattr("ctypes.CDLL", missing)
    keep_freed_memory()
