"""Native code: it is compiled for each processor, compiler and text, and found again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from coim.native import Source, find_compiler
from coim.objectives.native_gradients import (
    SOURCE,
)


def test_a_compiler_that_does_not_know_what_is_wished_for_does_without(tmp_path: Path) -> None:
    compiler = tmp_path / "c++"
    compiler.write_text(
        '#!/bin/sh\nfor word; do case $word in -fvect*) echo "unknown $word" >&2; exit 1;; esac; done\n'
        f'exec {find_compiler("install one")} "$@"\n'
    )
    compiler.chmod(0o755)
    command, _ = SOURCE.command(str(compiler))
    assert not {*SOURCE.wished} & {*command}
    assert {*SOURCE.options} <= {*command}


def test_a_changed_header_is_compiled_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    path, header = tmp_path / "source.cpp", tmp_path / "number.h"
    path.write_text('#include "number.h"\nextern "C" int number() { return NUMBER; }\n')
    source = Source(path=path, headers=(header,), options=(), purpose="numbers", way_out="guess")
    for number in (7, 8):
        header.write_text(f"#define NUMBER {number}\n")
        assert source.library().number() == number


def test_each_processor_compiler_option_and_version_has_code_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder may serve several machines, whose compilers predefine what their processors can do."""
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    path, compiler = tmp_path / "source.cpp", tmp_path / "c++"
    path.write_text('extern "C" int number() { return MACHINE; }\n')
    source = Source(path=path, options=("-O1",), purpose="numbers", way_out="guess")

    def number_on(machine: int, source: Source) -> int:
        compiler.write_text(f'#!/bin/sh\nexec {find_compiler("")} -DMACHINE={machine} "$@"\n')
        compiler.chmod(0o755)
        with monkeypatch.context() as patch:
            patch.setenv("CXX", str(compiler))
            return source.library().number()

    assert [number_on(machine, source) for machine in (1, 2, 1)] == [1, 2, 1]
    assert len([*tmp_path.rglob("*.so")]) == 2
    for other in (replace(source, options=("-O2",)), replace(source, made_from="MuJoCo 4")):
        before = len([*tmp_path.rglob("*.so")])
        assert number_on(1, other) == 1
        assert len([*tmp_path.rglob("*.so")]) == before + 1
