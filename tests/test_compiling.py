"""Compiling a function: what it computes, and what several threads see of it."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from coim import products
from coim.compiling import Compiled
from coim.products import Choice, affine, input_gradient, weight_gradient


def layer(x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor) -> list[torch.Tensor]:
    y = affine(x, weight, bias, "relu")
    return [y, input_gradient(y, weight), weight_gradient(x, y)]


def test_threads_that_call_at_once_get_what_the_plain_function_gives() -> None:
    x, weight, bias = torch.randn(40, 23), torch.randn(23, 12), torch.randn(12)
    quick = Compiled(layer, x.device)
    with torch.no_grad(), ThreadPoolExecutor(4) as threads:
        found = list(threads.map(lambda _: without_gradients(quick, x, weight, bias), range(4)))
        expected = layer(x, weight, bias)
    for values in found:
        for value, right in zip(values, expected):
            torch.testing.assert_close(value, right, rtol=1e-5, atol=1e-4)


def test_other_shapes_are_refused_instead_of_compiled_or_taken_uncompiled() -> None:
    quick = Compiled(layer, torch.device("cpu"))
    weight, bias = torch.randn(4, 3), torch.randn(3)
    without_gradients(quick, torch.randn(8, 4), weight, bias)
    with pytest.raises(RuntimeError, match="expected 8, actual 9"):
        without_gradients(quick, torch.randn(9, 4), weight, bias)


def test_inputs_that_are_checked_once_are_refused_where_they_differ() -> None:
    quick = Compiled(layer, torch.device("cpu"))
    x, weight, bias = torch.randn(8, 4), torch.randn(4, 3), torch.randn(3)
    with torch.no_grad():
        code = quick.checked(x, weight, bias)
        for value, right in zip(code(x + 1, weight, bias), layer(x + 1, weight, bias), strict=True):
            torch.testing.assert_close(value, right, rtol=1e-5, atol=1e-4)
        with pytest.raises(RuntimeError, match="expected 8, actual 9"):
            quick.checked(torch.randn(9, 4), weight, bias)


def test_compiled_code_follows_the_choice_of_products() -> None:
    x, weight, bias = (torch.randn(*shape).bfloat16() for shape in ((40, 23), (23, 12), (12,)))
    quick, before = Compiled(affine, x.device), products.chosen()
    choices = [Choice("torch", "emulated"), products.use("onednn")]
    try:
        for choice in choices * 2:
            products.use(choice)
            value, right = (without_gradients(function, x, weight, bias) for function in (quick, affine))
            torch.testing.assert_close(value, right, rtol=0.02, atol=0.02)
    finally:
        products.use(before)


def test_it_is_compiled_once_for_each_choice_of_products(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Choice] = []

    class Slow:
        def aot_compile(self, inputs: object) -> object:
            made.append(products.chosen())
            return lambda choice=made[-1]: choice

    monkeypatch.setattr("torch.compile", lambda function, **options: Slow())
    quick, before = Compiled(lambda: None, torch.device("cpu")), products.chosen()
    choices = [Choice("torch", "emulated"), products.use("onednn")]
    try:
        for choice in choices * 2:
            products.use(choice)
            assert quick() == choice
    finally:
        products.use(before)
    assert made == choices


def without_gradients(function: object, *args: torch.Tensor) -> list[torch.Tensor]:
    """Whether gradients are recorded is known to each thread alone."""
    with torch.no_grad():
        return function(*args)  # type: ignore[operator]
