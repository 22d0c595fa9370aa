"""Compiling a function: what it computes, and what several threads see of it. A CPU stands in for the GPU."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest
import torch

from coim.compiling import Compiled


def layer(x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor) -> list[torch.Tensor]:
    y = (x @ weight + bias).relu()
    return [y, y @ weight.mT, x.mT @ y]


def test_threads_that_call_at_once_get_what_the_plain_function_gives() -> None:
    x, weight, bias = torch.randn(40, 23), torch.randn(23, 12), torch.randn(12)
    quick = Compiled(layer)
    with torch.no_grad(), ThreadPoolExecutor(4) as threads:
        found = list(threads.map(lambda _: without_gradients(quick, x, weight, bias), range(4)))
        expected = layer(x, weight, bias)
    for values in found:
        for value, right in zip(values, expected):
            torch.testing.assert_close(value, right, rtol=1e-5, atol=1e-4)


def test_other_shapes_are_refused_instead_of_compiled_or_taken_uncompiled() -> None:
    quick = Compiled(layer)
    x, weight, bias = torch.randn(8, 4), torch.randn(4, 3), torch.randn(3)
    with torch.no_grad():
        code = quick.checked(x, weight, bias)
        for value, right in zip(code(x + 1, weight, bias), layer(x + 1, weight, bias), strict=True):
            torch.testing.assert_close(value, right, rtol=1e-5, atol=1e-4)
        for call in (quick, quick.checked):
            with pytest.raises(RuntimeError, match="expected 8, actual 9"):
                call(torch.randn(9, 4), weight, bias)


def test_it_is_compiled_once_for_all_who_have_inputs_of_the_same_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[object] = []

    class Slow:
        def aot_compile(self, inputs: object) -> object:
            made.append(inputs)
            return SimpleNamespace(guard_check=lambda *inputs: True, fn=layer)

    monkeypatch.setattr("torch.compile", lambda function, **options: Slow())
    inputs = torch.randn(7, 4), torch.randn(4, 3), torch.randn(3)
    for _ in range(2):
        assert Compiled(layer).checked(*inputs) is layer
    assert len(made) == 1
    assert Compiled(layer).checked(inputs[0][:5], *inputs[1:]) is layer
    assert len(made) == 2


def without_gradients(function: object, *args: torch.Tensor) -> list[torch.Tensor]:
    """Whether gradients are recorded is known to each thread alone."""
    with torch.no_grad():
        return function(*args)  # type: ignore[operator]
