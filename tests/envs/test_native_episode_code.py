"""How the code of native episodes is made and kept: once, whole, by any compiler, with the structures of its source."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from coim import (
    HopperMorph,
    make_policy,
    run_episode,
)
from coim.envs import native_episode
from coim.envs.native_episode import can_be_native, library
from coim.native import OPTIONS, Source, find_compiler


def test_code_is_made_once_for_all_processes_and_anew_if_it_is_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    runs: list[list[str]] = []
    really = Source.run
    monkeypatch.setattr(Source, "run", lambda source, command: (runs.append(command), really(source, command))[1])
    compiled = lambda: [command for command in runs if "-o" in command]  # noqa: E731
    library.__wrapped__()
    (made,) = tmp_path.rglob("*.so")
    library.__wrapped__()
    assert len(compiled()) == 1
    whole, seal = made.read_bytes(), made.with_suffix(".sha256")
    half = len(whole) // 2
    for damage in (whole[:100], whole[:half], whole[:half] + bytes(len(whole) - half)):  # loaded, the last two kill
        # Elsewhere each time, since a process loads no second library of the same path.
        elsewhere = tmp_path / f"other {len(runs)}"
        monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(elsewhere))
        damaged = elsewhere / made.relative_to(tmp_path)
        damaged.parent.mkdir(parents=True)
        damaged.write_bytes(damage)
        (damaged.parent / seal.name).write_text(seal.read_text())
        library.__wrapped__()
        assert damaged.read_bytes() == whole
        assert {*elsewhere.rglob("*.*")} == {damaged, damaged.parent / seal.name}
    assert len(compiled()) == 4


def test_without_a_compiler_or_with_one_that_fails_a_sentence_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library.cache_clear()
    try:
        monkeypatch.setenv("CXX", "no-such-compiler")
        assert not can_be_native()
        with pytest.raises(
            RuntimeError, match=r"no C\+\+ compiler \(no-such-compiler\) was found; install one, or leave"
        ):
            run_episode(HopperMorph(seed=0), make_policy(HopperMorph(seed=0), num_cells=(8,)), native=True)
        (tmp_path / "broken").write_bytes(b"\0")
        (tmp_path / "broken").chmod(0o755)
        monkeypatch.setenv("CXX", str(tmp_path / "broken"))
        assert not can_be_native()
        monkeypatch.setenv("CXX", "false")
        with pytest.raises(RuntimeError, match=r"cannot be compiled, leave native episodes out; \S*false -std"):
            library()
    finally:
        library.cache_clear()


def test_a_compiler_that_does_not_know_the_processor_compiles_for_any(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler = tmp_path / "c++"
    compiler.write_text(
        '#!/bin/sh\nfor word; do case $word in -m*=native) echo "unknown $word" >&2; exit 1;; esac; done\n'
        f'exec {find_compiler("")} "$@"\n'
    )
    compiler.chmod(0o755)
    monkeypatch.setenv("CXX", str(compiler))
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "cache"))
    assert hasattr(library.__wrapped__(), "act")
    assert native_episode.SOURCE.command(str(compiler))[0] == [str(compiler), *OPTIONS, *native_episode.SOURCE.options]


def test_the_structures_are_those_of_the_source(tmp_path: Path) -> None:
    """Names and sizes of all fields, in their order, as the compiler sees them."""
    source = native_episode.SOURCE.path.read_text()
    checks = []
    for name, structure in (("Layer", native_episode._Layer), ("Episode", native_episode._Episode)):
        checks.append(f"static_assert(sizeof({name}) == {native_episode.ctypes.sizeof(structure)});")
        for field, _ in structure._fields_:
            place = getattr(structure, field)
            checks.append(f"static_assert(offsetof({name}, {field}) == {place.offset});")
    assert len(checks) == 2 + 6 + 27
    file = tmp_path / "check.cpp"
    file.write_text("#include <cstddef>\n" + source + "\n".join(checks))
    command, _ = native_episode.SOURCE.command(find_compiler(""))
    native_episode.SOURCE.run([*command, str(file), "-o", os.devnull])
    assert re.search(r"enum Ending \{ WHOLE = 0, BROKEN = 1, NOT_FINITE = 2 \};", source)
    assert (native_episode.BROKEN, native_episode.NOT_FINITE) == (1, 2)
