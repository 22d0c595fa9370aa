import math

import pytest
import torch
from tensordict import TensorDict

from coim.models import GaussianEnsemble, select_run
from coim.objectives import EnsembleNLLLoss

KEYS = ("observation", "action", "design")


def ensemble_on(rows: TensorDict, **kwargs) -> GaussianEnsemble:
    """An ensemble in float64 with the statistics of rows of a ToyEnv."""
    ensemble = GaussianEnsemble(3, 2, 2, num_cells=(8, 8), **kwargs).double()
    ensemble.update_statistics(rows)
    return ensemble


def inputs(rows: TensorDict) -> list[torch.Tensor]:
    return [rows[key] for key in KEYS]


def index_ensemble(num_members: int) -> GaussianEnsemble:
    """Members whose next observation is their index."""
    ensemble = GaussianEnsemble(1, 1, 1, num_members=num_members, num_cells=(4,), predict="next")
    last = ensemble.network.layers[-1]
    last.weight.data.zero_()
    last.bias.data[:, 0] = torch.arange(num_members, dtype=torch.float32)
    return ensemble


def test_it_writes_the_gaussian_of_each_member(toy_env, make_rows):
    rows = make_rows(7, 5)
    out = GaussianEnsemble.for_env(toy_env, num_members=4, num_cells=(8,)).double()(rows.select(*KEYS))
    assert out["mean"].shape == out["log_var"].shape == (7, 5, 4, 3)


@pytest.mark.parametrize("predict", ["delta", "next"])
def test_moments_undo_the_standardisation(make_rows, predict):
    rows = make_rows(50)
    ensemble = ensemble_on(rows, predict=predict)
    out = ensemble(rows.select(*KEYS))
    target = rows["next", "observation"] - (rows["observation"] if predict == "delta" else 0)
    mean, std = target.mean(0), target.std(0, correction=0)
    base = rows["observation"].unsqueeze(1) if predict == "delta" else 0
    ours, var = ensemble.moments(*inputs(rows))
    torch.testing.assert_close(ours, out["mean"] * std + mean + base)
    torch.testing.assert_close(var, out["log_var"].exp() * std**2)
    standard = ensemble.standardised_target(rows["observation"], rows["next", "observation"])
    torch.testing.assert_close(standard, (target - mean) / std)


def test_log_variance_stays_between_its_bounds(make_rows):
    rows = make_rows(50)
    ensemble = ensemble_on(rows)
    last = ensemble.network.layers[-1]
    for bias, bound in [(1e3, 0.5), (-1e3, -10.0)]:
        last.bias.data.fill_(bias)
        torch.testing.assert_close(
            ensemble(rows.select(*KEYS))["log_var"], torch.full((50, 3, 3), bound).double(), atol=1e-4, rtol=0
        )
    last.bias.data.fill_(-4.0)
    last.weight.data.zero_()
    assert ensemble(rows.select(*KEYS))["log_var"].unique().item() == pytest.approx(-4.0, abs=0.02)


def test_ts1_draws_every_member_equally_often():
    zeros = torch.zeros(30_000, 1)
    drawn = index_ensemble(3).sample(zeros, zeros, zeros, noise=zeros, generator=torch.Generator().manual_seed(0))
    values, counts = drawn.unique(return_counts=True)
    assert values.tolist() == [0.0, 1.0, 2.0]
    assert counts.double().div(30_000).tolist() == pytest.approx([1 / 3] * 3, abs=0.01)  # 4 standard errors


def test_ts1_draws_members_row_by_row():
    zeros = torch.zeros(9_000, 1)
    drawn = index_ensemble(3).sample(zeros, zeros, zeros, noise=zeros, generator=torch.Generator().manual_seed(0))
    repeats = (drawn[1:] == drawn[:-1]).double().mean().item()
    assert repeats == pytest.approx(1 / 3, abs=0.02)


def test_the_same_generator_seed_gives_the_same_sample(make_rows):
    ensemble, x = ensemble_on(make_rows(20)), inputs(make_rows(20))
    first, second, third = (ensemble.sample(*x, generator=torch.Generator().manual_seed(s)) for s in (0, 0, 1))
    assert torch.equal(first, second)
    assert not torch.equal(first, third)


def test_a_generator_may_be_on_another_device_than_the_model(monkeypatch):
    ensemble = GaussianEnsemble(3, 2, 2, num_cells=(8,), predict="next").to("meta")
    seen = []
    monkeypatch.setattr(ensemble, "_grouped", lambda x, members: seen.append(members) or x.new_zeros(9, 6))
    x = [torch.zeros(9, size, device="meta") for size in (3, 2, 2)]
    generator, expected = (torch.Generator().manual_seed(0) for _ in range(2))
    assert ensemble.sample(*x, generator=generator).device.type == seen[0].device.type == "meta"
    torch.randint(3, (9,), generator=expected)
    torch.randn(9, 3, generator=expected)
    assert torch.equal(generator.get_state(), expected.get_state())


def test_statistics_survive_half_precision(make_rows):
    ensemble = GaussianEnsemble(3, 2, 2, num_cells=(8,)).to(torch.bfloat16)
    ensemble.update_statistics(make_rows(3_000))
    assert ensemble.inputs.count.item() == ensemble.targets.count.item() == 3_000
    assert ensemble.network.layers[0].weight.dtype == torch.bfloat16


@pytest.mark.parametrize("runs", [None, 2])
@pytest.mark.parametrize("predict", ["delta", "next"])
def test_grouping_gives_what_evaluating_all_members_and_gathering_gives(make_rows, runs, predict):
    rows = make_rows(2_000, 2)  # more rows than one chunk
    ensemble = ensemble_on(rows, num_runs=runs, num_members=4, predict=predict)
    members, noise = torch.randint(4, (2_000, 2)), torch.randn(2_000, 2, 3, dtype=torch.float64)
    mean, var = ensemble.moments(*inputs(rows))
    index = members[..., None, None].expand(-1, -1, 1, 3)
    expected = mean.gather(-2, index).squeeze(-2) + var.gather(-2, index).squeeze(-2).sqrt() * noise
    sampled = ensemble.sample(*inputs(rows), members=members, noise=noise)
    torch.testing.assert_close(sampled, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("num_members", [1, 4])
@pytest.mark.parametrize("runs", [None, 2])
def test_sampling_without_gradients_draws_the_same(monkeypatch, make_rows, runs, num_members):
    rows = make_rows(2_000, 2, dtype=torch.float32)
    ensemble = ensemble_on(rows, num_runs=runs, num_members=num_members).float()
    members = torch.randint(max(1, num_members - 1), (2_000, 2))  # the last of four has no rows
    noise = torch.randn(2_000, 2, 3)
    expected = ensemble.sample(*inputs(rows), members=members, noise=noise).detach()
    monkeypatch.setattr(ensemble, "_grouped_chunk", None)
    with torch.no_grad():
        sampled = ensemble.sample(*inputs(rows), members=members, noise=noise)
    torch.testing.assert_close(sampled, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("num_rows", [9, 3_000])
def test_samples_under_autocast_are_those_without_it_to_its_precision(make_rows, num_rows):
    rows = make_rows(num_rows, dtype=torch.float32)
    ensemble = ensemble_on(rows).float()
    given = {"members": torch.randint(3, (num_rows,)), "noise": torch.randn(num_rows, 3)}
    with torch.no_grad():
        expected = ensemble.sample(*inputs(rows), **given)
        with torch.autocast("cpu", torch.bfloat16):
            sampled = ensemble.sample(*inputs(rows), **given)
    assert sampled.dtype == torch.float32
    torch.testing.assert_close(sampled, expected, rtol=0.05, atol=0.05)


@pytest.mark.parametrize("runs", [None, 2])
@pytest.mark.parametrize("grad", [True, False])
def test_samples_are_of_the_network_as_it_is_called(make_rows, runs, grad):
    ensemble, rows = GaussianEnsemble(3, 2, 2, num_cells=(8,), num_runs=runs), make_rows(300, 2, dtype=torch.float32)
    ensemble.network.register_forward_hook(lambda module, given, out: 2 * out)
    members = torch.randint(3, (300, 2))
    with torch.set_grad_enabled(grad):
        sampled = ensemble.sample(*inputs(rows), members=members, noise=torch.zeros(300, 2, 3))
        mean = ensemble.moments(*inputs(rows))[0].take_along_dim(members[..., None, None], -2).squeeze(-2)
    torch.testing.assert_close(sampled, mean)


def test_a_sample_has_the_moments_of_its_member(make_rows):
    rows = make_rows(1)
    ensemble, many = ensemble_on(make_rows(50)), make_rows(1).expand(1, 20_000).reshape(-1)
    mean, var = ensemble.moments(*inputs(rows))
    members = torch.full((20_000,), 2)
    drawn = ensemble.sample(*inputs(many), members=members, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(drawn.mean(0), mean[0, 2], atol=0.05, rtol=0)
    torch.testing.assert_close(drawn.var(0), var[0, 2], rtol=0.05, atol=0)


def test_any_batch_shape_can_be_sampled(make_rows):
    ensemble = ensemble_on(make_rows(9))
    for batch in [(), (1,), (4, 1, 2), (0,)]:
        assert ensemble.sample(*inputs(make_rows(*batch))).shape == (*batch, 3)


def test_a_sample_is_differentiable(make_rows):
    ensemble, rows = ensemble_on(make_rows(9)), make_rows(9)
    action = rows["action"].requires_grad_()
    ensemble.sample(rows["observation"], action, rows["design"]).sum().backward()
    assert (action.grad != 0).all()


def test_a_run_of_a_fleet_is_an_ensemble_of_its_own(make_rows):
    rows = make_rows(40, 3)
    fleet = ensemble_on(rows, num_runs=3)
    members, noise = torch.randint(3, (40, 3)), torch.randn(40, 3, 3, dtype=torch.float64)
    out = fleet(rows.select(*KEYS))
    sampled = fleet.sample(*inputs(rows), members=members, noise=noise)
    for k in range(3):
        mine, alone = rows[:, k], select_run(fleet, k)
        assert alone.num_runs is None
        fresh = GaussianEnsemble(3, 2, 2, num_cells=(8, 8)).double()
        fresh.update_statistics(mine)
        torch.testing.assert_close(alone.targets.std, fresh.targets.std)
        ours = alone(mine.select(*KEYS))
        for key in ("mean", "log_var"):
            torch.testing.assert_close(out[key][:, k], ours[key], rtol=1e-12, atol=1e-13)
        expected = alone.sample(*inputs(mine), members=members[:, k], noise=noise[:, k])
        torch.testing.assert_close(sampled[:, k], expected, rtol=1e-12, atol=1e-13)


def test_angles_take_the_short_way_round():
    ensemble = GaussianEnsemble(2, 1, 1, num_cells=(4,), angle_indices=(1,))
    before, after = torch.tensor([[3.0, 3.0]]), torch.tensor([[-3.0, -3.0]])
    target = ensemble.standardised_target(before, after)
    torch.testing.assert_close(target, torch.tensor([[-6.0, 2 * math.pi - 6]]))


@pytest.mark.parametrize("predict", ["delta", "next"])
def test_a_predicted_angle_is_wrapped(predict):
    ensemble = GaussianEnsemble(2, 1, 1, num_cells=(4,), angle_indices=(1,), predict=predict)
    zeros, noise = torch.zeros(500, 1), torch.randn(500, 2)
    ensemble.network.layers[-1].weight.data.zero_()
    ensemble.network.layers[-1].bias.data.fill_(4.0)
    start = torch.tensor([3.0, 3.0]).expand(500, 2)
    drawn = ensemble.sample(start, zeros, zeros, noise=noise)
    mean, _ = ensemble.moments(start, zeros, zeros)
    for angle in (drawn, mean):
        assert angle[..., 0].max() > math.pi > angle[..., 1].abs().max()


def test_an_environment_tells_its_angles(toy_env):
    toy_env.angle_indices = (2,)
    assert GaussianEnsemble.for_env(toy_env, num_cells=(4,)).angle_indices == (2,)


def test_an_unseen_design_is_not_magnified_after_one_design(toy_env, make_rows):
    rows = make_rows(50)
    rows["design"][:] = 1.0
    rows["design"][0, 0] = 1.001
    ensemble = GaussianEnsemble.for_env(toy_env, num_cells=(4,)).double()
    ensemble.update_statistics(rows)
    x = torch.cat([rows["observation"], rows["action"], torch.full((50, 2), 2.0)], -1)
    assert ensemble.inputs(x)[:, -2:].max() == pytest.approx(math.sqrt(12) / 1.5, rel=1e-3)  # 2.3 uniform deviations


@pytest.mark.parametrize("predict", ["delta", "next"])
def test_a_linear_system_is_learnt_to_its_noise_level(make_rows, predict):
    torch.manual_seed(0)
    train, test = make_rows(4_000, dtype=torch.float32), make_rows(1_000, seed=1, dtype=torch.float32)  # noise 0.1
    ensemble = GaussianEnsemble(3, 2, 2, num_members=2, num_cells=(32, 32), predict=predict)
    ensemble.update_statistics(train)
    loss, optimiser = EnsembleNLLLoss(ensemble), torch.optim.Adam(ensemble.parameters(), lr=3e-3)
    for step in range(1_500):
        if step == 1_000:
            optimiser.param_groups[0]["lr"] = 3e-4
        optimiser.zero_grad()
        loss(train[torch.randint(4_000, (256,))])["loss_dynamics"].backward()
        optimiser.step()
    with torch.no_grad():
        mean, var = ensemble.moments(*inputs(test))
    error = (mean - test["next", "observation"].unsqueeze(1)).square().mean().sqrt().item()
    assert error == pytest.approx(0.1, rel=0.1)
    assert var.sqrt().mean().item() == pytest.approx(0.1, rel=0.1)


def test_a_state_dict_brings_weights_and_statistics_back(make_rows):
    rows = make_rows(20)
    ensemble, other = ensemble_on(rows), ensemble_on(make_rows(30, seed=1))
    other.load_state_dict(ensemble.state_dict())
    for ours, theirs in zip(ensemble.moments(*inputs(rows)), other.moments(*inputs(rows))):
        assert torch.equal(ours, theirs)


def test_bad_input_is_named(make_rows):
    with pytest.raises(ValueError, match="predict='state' is unknown; choose 'delta' or 'next'"):
        GaussianEnsemble(3, 2, 2, predict="state")
    with pytest.raises(ValueError, match=r"angle indices \[3\] must lie in 0 \.\. 2"):
        GaussianEnsemble(3, 2, 2, angle_indices=(3,))
    for read in (GaussianEnsemble(4, 2, 1).sample, GaussianEnsemble(3, 2, 3).moments):
        with pytest.raises(ValueError, match=r"have \[3, 2, 2\] numbers, this model reads ., of which . are observed"):
            read(*inputs(make_rows(4)))
    with pytest.raises(IndexError, match=r"members must lie in 0 \.\. 2"):
        ensemble_on(make_rows(4)).sample(*inputs(make_rows(4)), members=torch.full((4,), 3))
