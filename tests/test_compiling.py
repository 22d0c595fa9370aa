"""Compiling a function: what it computes, and what several threads see of it."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor

import torch

from coim.compiling import compiled
from coim.products import affine, input_gradient, weight_gradient

CALLS = 1_000


def layer(x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor) -> list[torch.Tensor]:
    y = affine(x, weight, bias, "relu")
    return [y, input_gradient(y, weight), weight_gradient(x, y)]


def test_threads_that_call_at_once_get_what_the_plain_function_gives() -> None:
    x, weight, bias = torch.randn(40, 23), torch.randn(23, 12), torch.randn(12)
    quick = compiled(layer, x.device)
    with torch.no_grad(), ThreadPoolExecutor(4) as threads:
        found = list(threads.map(lambda _: without_gradients(quick, x, weight, bias), range(4)))
        expected = layer(x, weight, bias)
    for values in found:
        for value, right in zip(values, expected):
            torch.testing.assert_close(value, right, rtol=1e-5, atol=1e-4)


def test_threads_do_not_disturb_each_other_while_they_call() -> None:
    """torch 2.13 counts the frames of ``fullgraph=True`` in one place for all threads."""
    x, weight, bias = torch.randn(8, 4), torch.randn(4, 3), torch.randn(3)
    functions = [compiled(layer, x.device), compiled(lambda *args: layer(*args)[:1], x.device)]

    def call_often(quick: object) -> None:
        for _ in range(CALLS):
            without_gradients(quick, x, weight, bias)

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # or the threads would take turns at the wrong moment but once in many thousand calls
    try:
        with ThreadPoolExecutor(2) as threads:
            assert list(threads.map(call_often, functions)) == [None, None]
    finally:
        sys.setswitchinterval(before)


def without_gradients(function: object, *args: torch.Tensor) -> list[torch.Tensor]:
    """Whether gradients are recorded is known to each thread alone."""
    with torch.no_grad():
        return function(*args)  # type: ignore[operator]
