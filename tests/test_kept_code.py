"""Compiled code that a later process finds again, and when it does not."""

from __future__ import annotations

import os
import subprocess
import sys
from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from coim import SACLearner, compiling, make_policy, make_qvalue, products
from coim.compiling import Compiled, described
from coim.kept_code import fingerprint
from coim.objectives.gradients import sac_gradients
from coim.products import affine

CPU = torch.device("cpu")
INPUTS = torch.linspace(-1, 1, 12).reshape(4, 3), torch.linspace(0, 2, 6).reshape(3, 2), torch.ones(2)


@pytest.fixture(autouse=True)
def compilations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A folder of compiled code for each test, in a process that has none; and what was compiled."""
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    made: list[str] = []
    compile = compiling._compile

    def counted(function: Any, *rest: Any) -> Any:
        made.append(function.__name__)
        return compile(function, *rest)

    monkeypatch.setattr(compiling, "_compile", counted)
    monkeypatch.setattr(compiling, "_MADE", {})
    return made


def in_a_new_process(*inputs: torch.Tensor) -> torch.Tensor:
    """Call `affine`, compiled, as a process does that has compiled nothing yet."""
    compiling._MADE.clear()
    with torch.no_grad():
        return Compiled(affine, CPU)(*inputs)


def files(folder: Path) -> list[Path]:
    return sorted((folder / "coim").iterdir()) if (folder / "coim").exists() else []


def test_a_later_process_finds_the_code_and_gets_the_same_bits(tmp_path: Path, compilations: list[str]) -> None:
    first, second = in_a_new_process(*INPUTS), in_a_new_process(*INPUTS)
    assert compilations == ["affine"]
    assert len(files(tmp_path)) == 1
    assert torch.equal(first, second)
    torch.testing.assert_close(first, affine(*INPUTS))


def test_kept_code_refuses_other_shapes_too(compilations: list[str]) -> None:
    in_a_new_process(*INPUTS)
    compiling._MADE.clear()
    quick = Compiled(affine, CPU)
    with torch.no_grad():
        quick(*INPUTS)
        with pytest.raises(RuntimeError, match="expected 4, actual 5"):
            quick(torch.zeros(5, 3), *INPUTS[1:])
    assert compilations == ["affine"]


def test_other_sizes_threads_and_products_are_other_code(tmp_path: Path, compilations: list[str]) -> None:
    in_a_new_process(*INPUTS)
    in_a_new_process(torch.zeros(5, 3), *INPUTS[1:])
    threads, choice = torch.get_num_threads(), products.chosen()
    try:
        torch.set_num_threads(threads + 1)
        in_a_new_process(*INPUTS)
        torch.set_num_threads(threads)
        products.use("onednn" if choice.float32 == "torch" else "torch")
        in_a_new_process(*INPUTS)
    finally:
        torch.set_num_threads(threads)
        products.use(choice)
    assert len(compilations) == len(files(tmp_path)) == 4


@pytest.mark.parametrize("content", [b"", b"no compiled code"])
def test_what_cannot_be_read_is_compiled_anew(tmp_path: Path, compilations: list[str], content: bytes) -> None:
    first = in_a_new_process(*INPUTS)
    (file,) = files(tmp_path)
    file.write_bytes(content)
    assert torch.equal(in_a_new_process(*INPUTS), first)
    assert torch.equal(in_a_new_process(*INPUTS), first)
    assert compilations == ["affine"] * 2  # what was made anew is kept


LATER = """
import sys, torch
from coim import compiling
from coim.compiling import Compiled
from coim.products import affine
def refuse(*args): raise AssertionError("compiled")
if sys.argv[1] == "finds":
    compiling._compile = refuse
inputs = torch.linspace(-1, 1, 12).reshape(4, 3), torch.linspace(0, 2, 6).reshape(3, 2), torch.ones(2)
with torch.no_grad():
    print(Compiled(affine, torch.device("cpu"))(*inputs).tolist())
"""


def test_a_process_with_other_hashes_finds_what_another_one_kept() -> None:
    said = []
    for seed, way in enumerate(("makes", "finds")):
        command = [sys.executable, "-c", LATER, way]
        environment = os.environ | {"PYTHONHASHSEED": str(seed), "OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        said.append(done.stdout)
    assert said[0] == said[1]


def test_a_function_that_was_replaced_is_other_code(compilations: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Also one that is reached through another."""
    before = fingerprint(sac_gradients)
    assert fingerprint(sac_gradients) == before
    monkeypatch.setattr("coim.objectives.gradients.soft_value", lambda q, log_prob, alpha: 100 + q.amin(-1))
    assert fingerprint(sac_gradients) != before
    right = in_a_new_process(*INPUTS)
    monkeypatch.setattr("coim.products._by_onednn", lambda *args: False)
    monkeypatch.setattr("coim.products.emulated", lambda x: False)
    torch.testing.assert_close(in_a_new_process(*INPUTS), right)
    assert compilations == ["affine"] * 2


def test_constants_defaults_and_functions_within_functions_are_told_apart() -> None:
    def scaled(factor: float, shift: int = 0) -> Any:
        return lambda x: (lambda y: factor * y)(x) + shift

    assert fingerprint(scaled(2.0)) == fingerprint(scaled(2.0))
    assert len({fingerprint(scaled(*with_)) for with_ in ((2.0,), (3.0,), (2.0, 1))}) == 3


def test_what_code_is_made_for_is_told_apart() -> None:
    x = torch.zeros(4, 4)
    kinds = [((x,), {}), ((x.double(),), {}), ((x[:2],), {}), ((torch.zeros(8, 4)[::2],), {})]
    kinds += [((x.clone().requires_grad_(),), {}), ((x, x), {}), ((x, x.clone()), {}), ((x,), {"low": -5.0})]
    kinds += [((x,), {"low": -4.0}), (([x],), {})]
    assert len({described(*kind) for kind in kinds}) == len(kinds)
    with torch.no_grad():
        without_gradients = described((x,), {})
    assert without_gradients != described((x,), {})


def test_a_state_of_torch_that_the_guards_know_is_compiled_anew(compilations: list[str]) -> None:
    in_a_new_process(*INPUTS)
    try:
        torch.use_deterministic_algorithms(True)
        with torch.no_grad():
            torch.testing.assert_close(Compiled(affine, CPU)(*INPUTS), affine(*INPUTS))
    finally:
        torch.use_deterministic_algorithms(False)
    assert compilations == ["affine"] * 2


def of_somebody_else(x: torch.Tensor) -> torch.Tensor:
    return x.tanh()


def test_nothing_is_kept_of_functions_of_others(tmp_path: Path, compilations: list[str]) -> None:
    with torch.no_grad():
        assert Compiled(of_somebody_else, CPU)(torch.zeros(2)).tolist() == [0, 0]
        assert Compiled(of_somebody_else, CPU)(torch.zeros(2)).tolist() == [0, 0]
    assert compilations == ["of_somebody_else"]  # in this process it is shared
    assert not files(tmp_path)


def test_a_full_disk_takes_nothing_from_a_run(
    tmp_path: Path, compilations: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(source: Path, target: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("coim.kept_code.os.replace", full)
    torch.testing.assert_close(in_a_new_process(*INPUTS), affine(*INPUTS))
    assert not files(tmp_path)


def test_learners_of_equal_networks_share_their_code(
    toy_env: Any, make_rows: Any, compilations: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def plain(function: Any, *rest: Any) -> Any:
        compilations.append(function.__name__)
        return SimpleNamespace(guard_check=lambda *args, **kwargs: True, fn=function)

    monkeypatch.setattr(compiling, "_compile", plain)
    rows = make_rows(1, 8, dtype=torch.float32)
    learners = [
        SACLearner(make_policy(toy_env, num_cells=(4,)), make_qvalue(toy_env, num_cells=(4,)), compile=True, seed=seed)
        for seed in range(2)
    ]
    found = [learner.update(rows)["loss_qvalue"] for learner in learners]
    assert compilations == ["sac_gradients_in_order"]
    assert not torch.equal(*found)


def test_a_learner_that_was_compiled_can_be_copied(toy_env: Any, make_rows: Any) -> None:
    rows = make_rows(1, 8, dtype=torch.float32)
    learner = SACLearner(make_policy(toy_env, num_cells=(4,)), make_qvalue(toy_env, num_cells=(4,)), compile=True)
    learner.update(rows)
    copied = deepcopy(learner)
    assert torch.equal(copied.weights_by_run()[0], learner.weights_by_run()[0])
