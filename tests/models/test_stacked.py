from functools import partial

import pytest
import torch
from torch import nn

from coim.models import StackedMLP, select_run
from coim.models.stacked import FEW_ROWS

STACKS = [(None, None), (None, 3), (2, None), (2, 3)]


def torch_mlp(mlp: StackedMLP, *index: int) -> nn.Sequential:
    """The same copy made of torch.nn.Linear layers."""
    parts: list[nn.Module] = []
    for layer in mlp.layers:
        linear = nn.Linear(layer.weight.shape[-2], layer.weight.shape[-1], dtype=layer.weight.dtype)
        linear.weight.data, linear.bias.data = layer.weight.data[index].T.clone(), layer.bias.data[index].clone()
        parts += [linear, nn.ReLU()]
    return nn.Sequential(*parts[:-1])


@pytest.mark.parametrize(("runs", "copies"), STACKS)
def test_every_copy_is_a_torch_mlp(runs, copies):
    mlp = StackedMLP(5, 4, [7, 6], num_runs=runs, num_copies=copies, dtype=torch.float64)
    x = torch.randn(2, 9, *([] if runs is None else [runs]), 5, dtype=torch.float64)
    out = mlp(x[..., :2], x[..., 2:])
    assert out.shape == (*x.shape[:-1], *([] if copies is None else [copies]), 4)
    for k in range(runs or 1):
        for n in range(copies or 1):
            index = (k,) * (runs is not None) + (n,) * (copies is not None)
            rows = x if runs is None else x[:, :, k]
            ours = out if runs is None else out[:, :, k]
            ours = ours if copies is None else ours[..., n, :]
            torch.testing.assert_close(ours, torch_mlp(mlp, *index)(rows), rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize(("runs", "copies"), STACKS)
def test_each_copy_on_rows_of_its_own(runs, copies):
    mlp = StackedMLP(5, 4, [7], num_runs=runs, num_copies=copies, dtype=torch.float64)
    groups = (runs or 1) * (copies or 1)
    x = torch.randn(groups, 9, 5, dtype=torch.float64)
    out = mlp.forward_stacked(x)
    for g in range(groups):
        index = () if not mlp.stack else tuple(int(i) for i in torch.unravel_index(torch.tensor(g), mlp.stack))
        torch.testing.assert_close(out[g], torch_mlp(mlp, *index)(x[g]), rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("activation", [nn.ReLU, nn.SiLU])
@pytest.mark.parametrize(("runs", "copies"), STACKS)
def test_without_gradients_it_computes_the_same_one_copy_after_the_other(monkeypatch, runs, copies, activation):
    mlp = StackedMLP(5, 4, [70, 60], num_runs=runs, num_copies=copies, activation=activation)
    x = torch.randn(30, 100, *([] if runs is None else [runs]), 5)  # more rows than one chunk
    expected = mlp(x).detach()
    monkeypatch.setattr(mlp, "_product", None)
    with torch.no_grad():
        out = mlp(x[..., :2], x[..., 2:])
    torch.testing.assert_close(out, expected, rtol=1e-5, atol=1e-6)
    monkeypatch.undo()
    with torch.no_grad():
        rounded = mlp.bfloat16()(x.bfloat16())
    assert rounded.dtype == torch.bfloat16
    torch.testing.assert_close(rounded.float(), expected, rtol=0.05, atol=0.02)


def test_a_function_transform_is_left_to_itself_without_gradients():
    many = [StackedMLP(5, 2, [7], num_copies=2) for _ in range(3)]
    x = torch.randn(200, 5)
    params, buffers = torch.func.stack_module_state(many)
    call = partial(torch.func.functional_call, many[0])
    with torch.no_grad():
        over_weights = torch.vmap(lambda p: call((p, buffers), x))(params)
        over_rows = torch.vmap(many[0])(x.expand(4, 200, 5))
        expected = torch.stack([mlp(x) for mlp in many])
    torch.testing.assert_close(over_weights, expected, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(over_rows[3], expected[0], rtol=1e-5, atol=1e-6)


def test_an_activation_that_no_library_fuses_works_without_gradients():
    mlp = StackedMLP(5, 2, [7], activation=nn.LeakyReLU)
    x = torch.randn(200, 5)
    with torch.no_grad():
        torch.testing.assert_close(mlp(x), mlp.requires_grad_(False)(x))
    assert (mlp(x) != 0).all()


def test_no_gradient_crosses_runs():
    mlp = StackedMLP(5, 1, [7], num_runs=3, num_copies=2)
    x = torch.randn(9, 3, 5, requires_grad=True)
    mlp(x)[:, 1].sum().backward()
    for tensor, run_axis in [(x.grad, 1), *((p.grad, 0) for p in mlp.parameters())]:
        touched = [bool(part.any()) for part in tensor.unbind(run_axis)]
        assert touched == [False, True, False]


def test_a_fleet_is_initialised_as_torch_does_and_each_copy_independently():
    mlp = StackedMLP(100, 50, [], num_runs=2, num_copies=2)
    weight = mlp.layers[0].weight.detach()
    assert weight.abs().max() <= 0.1  # 1 / sqrt(100)
    assert weight.std().item() == pytest.approx(0.1 / 3**0.5, rel=0.02)
    assert len({round(w.sum().item(), 6) for w in weight.flatten(0, 1)}) == 4


def test_the_same_generator_seed_gives_the_same_weights():
    mlp = StackedMLP(5, 1, [7])
    mlp.reset_parameters(torch.Generator().manual_seed(3))
    first = mlp.layers[0].weight.clone()
    mlp.reset_parameters(torch.Generator().manual_seed(3))
    assert torch.equal(first, mlp.layers[0].weight)


def test_a_selected_run_computes_the_same_and_shares_nothing():
    fleet = StackedMLP(5, 2, [7], num_runs=3, num_copies=2, dtype=torch.float64)
    x = torch.randn(9, 3, 5, dtype=torch.float64)
    expected = fleet(x)[:, 2]
    alone = select_run(fleet, 2)
    fleet.reset_parameters()
    assert (alone.num_runs, alone.num_copies) == (None, 2)
    torch.testing.assert_close(alone(x[:, 2]), expected, rtol=1e-13, atol=1e-14)
    assert all(p.requires_grad for p in alone.parameters())


def test_an_empty_batch_gives_an_empty_output():
    assert StackedMLP(5, 2, [7], num_copies=2)(torch.zeros(0, 5)).shape == (0, 2, 2)


def test_bad_input_is_named():
    with pytest.raises(ValueError, match=r"sizes \[3, 3\] have 6 features, this network 5"):
        StackedMLP(5, 1, [7])(torch.zeros(4, 3), torch.zeros(4, 3))
    with pytest.raises(ValueError, match="needs the 3 runs"):
        StackedMLP(5, 1, [7], num_runs=3)(torch.zeros(4, 5))
    with pytest.raises(ValueError, match="at least 1"):
        StackedMLP(5, 1, [7], num_copies=0)
    with pytest.raises(ValueError, match=r"layer sizes \[5, 7, 1\] and stack \(2.5,\) must all be whole numbers"):
        StackedMLP(5, 1, [7], num_copies=2.5)
    with pytest.raises(ValueError, match="has no run axis"):
        select_run(StackedMLP(5, 1, [7]), 0)
    with pytest.raises(IndexError, match=r"run 3 is outside 0 \.\. 2"):
        select_run(StackedMLP(5, 1, [7], num_runs=3), 3)


@pytest.mark.parametrize("part", ["layer", "activation"])
def test_hooks_count_in_every_batch(part):
    mlp = StackedMLP(3, 2, (8,))
    module = mlp.layers[0] if part == "layer" else mlp.activation
    module.register_forward_hook(lambda module, given, out: out + 1)
    rows = torch.randn(FEW_ROWS, 3)
    with torch.no_grad():
        torch.testing.assert_close(mlp(rows), torch.cat([mlp(half) for half in rows.chunk(2)]))
