"""The products of a layer against their definitions, for every way that they can take."""

from __future__ import annotations

import pytest
import torch

from coim import products

TOLERANCE = {torch.float64: 1e-12, torch.float32: 1e-5, torch.bfloat16: 3e-2}


def random(*shape: int, dtype: torch.dtype) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(len(shape))).to(dtype)


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
@pytest.mark.parametrize("stack", [(), (3,)], ids=["plain", "stacked"])
@pytest.mark.parametrize("outputs", [1, 12, 200])
def test_products_equal_their_definitions(dtype: torch.dtype, stack: tuple[int, ...], outputs: int) -> None:
    x, weight = random(*stack, 40, 23, dtype=dtype), random(*stack, 23, outputs, dtype=dtype) / 5
    bias, delta = random(*stack, outputs, dtype=dtype), random(*stack, 40, outputs, dtype=dtype) / 15
    wide = [t.double() for t in (x, weight, bias, delta)]
    expected = {
        "affine": wide[0] @ wide[1] + wide[2].unsqueeze(-2),
        "input": wide[3] @ wide[1].mT,
        "weight": wide[0].mT @ wide[3],
    }
    actual = {
        "affine": products.affine(x, weight, bias),
        "input": products.input_gradient(delta, weight),
        "weight": products.weight_gradient(x, delta),
    }
    for name, value in actual.items():
        assert value.dtype == dtype
        torch.testing.assert_close(value.double(), expected[name], rtol=TOLERANCE[dtype], atol=TOLERANCE[dtype])


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize(("activation", "function"), [("relu", torch.relu), ("swish", torch.nn.functional.silu)])
def test_activations_come_after_the_bias(dtype: torch.dtype, activation: str, function: object) -> None:
    x, weight, bias = random(9, 4, dtype=dtype), random(4, 5, dtype=dtype), random(5, dtype=dtype)
    tolerance = TOLERANCE[dtype]
    expected = function(x @ weight + bias)  # type: ignore[operator]
    torch.testing.assert_close(products.affine(x, weight, bias, activation), expected, rtol=tolerance, atol=tolerance)


def test_slices_and_transposes_are_read_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    x, weight = random(60, 30, dtype=torch.float32)[10:50, :23], random(200, 23, dtype=torch.float32).t()
    bias = torch.zeros(200)
    torch.testing.assert_close(products.affine(x, weight, bias), x @ weight, rtol=1e-5, atol=1e-4)


def test_without_onednn_the_usual_way_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(products, "_LINEAR", None)
    x, weight, bias = random(9, 4, dtype=torch.float32), random(4, 5, dtype=torch.float32), torch.ones(5)
    torch.testing.assert_close(products.affine(x, weight, bias, "relu"), torch.relu(x @ weight + bias))
