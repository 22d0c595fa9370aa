"""The products of a layer against their definitions, for every way that they can take, and which way is taken."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from coim import products
from coim.models.stacked import StackedMLP
from coim.products import Choice

TOLERANCE = {torch.float64: 1e-12, torch.float32: 1e-5, torch.bfloat16: 3e-2}
EPYC_9005, EPYC_7003, XEON = ("AVX512", "AuthenticAMD"), ("AVX2", "AuthenticAMD"), ("AVX512", "GenuineIntel")
NARROW_XEON, ARM = ("AVX2", "GenuineIntel"), ("DEFAULT", "")
WAYS = ["torch", "onednn", Choice("torch", "emulated"), Choice("onednn", "emulated")]


@pytest.fixture(autouse=True)
def choice_put_back() -> Iterator[None]:
    before = products.chosen()
    yield
    products.use(before)


@pytest.fixture(params=WAYS, ids=str)
def way(request: pytest.FixtureRequest) -> Choice:
    """Every way that this build of torch and this processor have."""
    if "onednn" in request.param and not torch.backends.mkldnn.is_available():
        pytest.skip("this build of torch has no oneDNN")
    return products.use(request.param)


def machine(monkeypatch: pytest.MonkeyPatch, instructions: str, maker: str, *, bfloat16: bool) -> None:
    monkeypatch.setattr("torch.backends.cpu.get_cpu_capability", lambda: instructions)
    monkeypatch.setattr(products, "_maker", lambda: f"vendor_id : {maker}")
    monkeypatch.setattr(products, "has_bfloat16", lambda: bfloat16)


def random(*shape: int, dtype: torch.dtype) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(len(shape))).to(dtype)


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
@pytest.mark.parametrize("stack", [(), (3,)], ids=["plain", "stacked"])
@pytest.mark.parametrize("outputs", [1, 12, 200])
def test_products_equal_their_definitions(
    way: Choice, dtype: torch.dtype, stack: tuple[int, ...], outputs: int
) -> None:
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
def test_activations_come_after_the_bias(way: Choice, dtype: torch.dtype, activation: str, function: object) -> None:
    x, weight, bias = random(9, 4, dtype=dtype), random(4, 5, dtype=dtype), random(5, dtype=dtype)
    tolerance = TOLERANCE[dtype]
    expected = function(x @ weight + bias)  # type: ignore[operator]
    torch.testing.assert_close(products.affine(x, weight, bias, activation), expected, rtol=tolerance, atol=tolerance)


def test_slices_and_transposes_are_read_as_they_are(way: Choice) -> None:
    x, weight = random(60, 30, dtype=torch.float32)[10:50, :23], random(200, 23, dtype=torch.float32).t()
    bias = torch.zeros(200)
    torch.testing.assert_close(products.affine(x, weight, bias), x @ weight, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("lies", ["every second one", "one number for all"])
def test_a_bias_is_read_wherever_it_lies(way: Choice, lies: str) -> None:
    x, weight = random(60, 23, dtype=torch.float32), random(23, 200, dtype=torch.float32)
    bias = random(400, dtype=torch.float32)[::2] if lies == "every second one" else torch.full((1,), 0.7).expand(200)
    torch.testing.assert_close(products.affine(x, weight, bias), x @ weight + bias, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
@pytest.mark.parametrize("activation", ["none", "relu", "swish"])
def test_a_number_that_is_no_number_stays_one(way: Choice, dtype: torch.dtype, activation: products.Activation) -> None:
    """A run that diverges is found by its losses, whichever library multiplies."""
    x, weight, bias = random(20, 23, dtype=dtype), random(23, 12, dtype=dtype), random(12, dtype=dtype)
    x[3, 5] = bias[7] = torch.nan
    lost = products.affine(x, weight, bias, activation).isnan()
    assert lost[3].all()
    assert lost[:, 7].all()
    assert lost.sum() == 20 + 12 - 1


def test_emulated_bfloat16_is_rounded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    products.use(Choice("torch", "emulated"))
    x, weight = random(40, 23, dtype=torch.bfloat16), random(23, 12, dtype=torch.bfloat16)
    exact = x.double() @ weight.double() + 1
    rounded = products.affine(x, weight, torch.ones(12, dtype=torch.bfloat16)).double()
    assert ((rounded - exact).abs() <= 2**-8 * exact.abs() + 1e-5).all()  # half a unit of the last of eight digits


def test_gradients_flow_through_emulated_layers() -> None:
    mlp, x = StackedMLP(4, 1, [8], num_copies=2).bfloat16(), random(9, 4, dtype=torch.bfloat16)
    gradients = []
    for choice in (products.chosen(), Choice("torch", "emulated")):
        products.use(choice)
        x = x.detach().requires_grad_()
        out = mlp(x)
        assert out.dtype == torch.bfloat16
        out.float().square().sum().backward()
        gradients.append(x.grad)
    torch.testing.assert_close(*gradients, rtol=0.05, atol=0.02)


@pytest.mark.parametrize(
    ("processor", "bfloat16", "expected"),
    [
        (EPYC_9005, True, Choice("onednn", "onednn")),
        (XEON, True, Choice("torch", "torch")),
        (XEON, False, Choice("torch", "emulated")),  # those of before 2020
        (EPYC_7003, False, Choice("torch", "emulated")),
        (NARROW_XEON, False, Choice("torch", "emulated")),
        (ARM, True, Choice("torch", "torch")),
        (ARM, False, Choice("torch", "emulated")),
    ],
)
def test_the_library_follows_from_the_processor(
    monkeypatch: pytest.MonkeyPatch, processor: tuple[str, str], bfloat16: bool, expected: Choice
) -> None:
    machine(monkeypatch, *processor, bfloat16=bfloat16)
    assert products.fastest() == products.use("auto") == products.chosen() == expected


def test_a_library_taken_by_name_emulates_what_the_processor_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    machine(monkeypatch, *EPYC_7003, bfloat16=False)
    assert products.use("onednn") == Choice("onednn", "emulated")
    with pytest.raises(ValueError, match="has no products of bfloat16; choose products 'auto', which emulates them"):
        products.use(Choice("onednn", "onednn"))
    assert products.chosen() == Choice("onednn", "emulated")  # what is refused changes nothing


def test_without_onednn_the_usual_way_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    machine(monkeypatch, *EPYC_9005, bfloat16=True)
    monkeypatch.setattr(products, "_LINEAR", None)
    assert products.use("auto") == Choice("torch", "torch")
    x, weight, bias = random(9, 4, dtype=torch.float32), random(4, 5, dtype=torch.float32), torch.ones(5)
    torch.testing.assert_close(products.affine(x, weight, bias, "relu"), torch.relu(x @ weight + bias))
    with pytest.raises(ValueError, match="no oneDNN; choose products 'torch' or 'auto'"):
        products.use("onednn")


def test_a_library_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ValueError, match="choose 'auto', 'onednn' or 'torch'"):
        products.use("mkl")  # type: ignore[arg-type]


def test_the_maker_is_read_where_the_system_tells(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coim.products.Path.open", lambda path: (_ for _ in ()).throw(FileNotFoundError))
    monkeypatch.setattr("platform.processor", lambda: "Intel64 Family 6 Model 85 Stepping 7, GenuineIntel")
    monkeypatch.setattr("torch.backends.cpu.get_cpu_capability", lambda: "AVX512")
    assert products.kind_of_processor() == "AVX-512 of Intel"
