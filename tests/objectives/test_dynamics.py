import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torch.distributions import Normal

from coim.models import GaussianEnsemble, select_run
from coim.objectives import EnsembleNLLLoss


def ensemble_on(rows: TensorDict, **kwargs) -> GaussianEnsemble:
    ensemble = GaussianEnsemble(3, 2, 2, num_cells=(8, 8), **kwargs).double()
    ensemble.update_statistics(rows)
    return ensemble


class Constant(TensorDictModuleBase):
    """A foreign ensemble of two members that predict 0 and 1 with unit variance, in keys of its own."""

    in_keys, out_keys = [("agent", "state")], [("out", "mean"), ("out", "log_var")]

    def __init__(self):
        super().__init__()
        self.mean = nn.Parameter(torch.tensor([[0.0], [1.0]], dtype=torch.float64))

    def forward(self, tensordict):
        mean = self.mean.expand(*tensordict.batch_size, 2, 1)
        return tensordict.set(("out", "mean"), mean).set(("out", "log_var"), torch.zeros_like(mean))

    @staticmethod
    def standardised_target(observation, next_observation):
        return next_observation - observation


def test_the_closed_form_with_foreign_nested_keys():
    loss = EnsembleNLLLoss(Constant())
    loss.set_keys(observation=("agent", "state"), mean=("out", "mean"), log_var=("out", "log_var"))
    assert loss.in_keys == [("agent", "state"), ("next", "agent", "state")]
    state = torch.tensor([[0.0], [1.0]], dtype=torch.float64)
    rows = TensorDict({"agent": {"state": state}, "next": {"agent": {"state": torch.tensor([[2.0], [4.0]])}}}, [2])
    out = loss(rows)["loss_dynamics"]  # changes 2 and 3: (4 + 9) / 2 + (1 + 4) / 2
    assert out.item() == 9.0
    out.backward()
    assert loss.ensemble.mean.grad.flatten().tolist() == [-5.0, -3.0]  # -2 (2.5 - member)


def test_means_without_the_axis_of_the_members_are_refused():
    class Alone(Constant):
        def forward(self, tensordict):
            super().forward(tensordict)
            return tensordict.set(("out", "mean"), tensordict["out", "mean"][..., 0, :])

    loss = EnsembleNLLLoss(Alone())
    loss.set_keys(observation=("agent", "state"), mean=("out", "mean"), log_var=("out", "log_var"))
    state = {"agent": {"state": torch.zeros(2, 1)}}
    with pytest.raises(ValueError, match=r"the members' means must be \[\*B, E, S\] with \*B = \[2\], .* \*B = \[\]"):
        loss(TensorDict({**state, "next": state}, [2]))


def test_it_is_the_density_of_torchs_normal(make_rows):
    rows = make_rows(20)
    ensemble = ensemble_on(rows)
    out = ensemble(rows.select(*ensemble.in_keys))
    target = ensemble.standardised_target(rows["observation"], rows["next", "observation"]).unsqueeze(1)
    density = Normal(out["mean"], (out["log_var"] / 2).exp()).log_prob(target).sum(-1)  # [20, 3]
    expected = (-2 * density - 3 * math.log(2 * math.pi)).mean(0).sum()
    torch.testing.assert_close(EnsembleNLLLoss(ensemble)(rows)["loss_dynamics"], expected, rtol=1e-13, atol=0)


def test_each_member_gets_the_gradient_it_would_have_alone(make_rows):
    rows = make_rows(20)
    ensemble = ensemble_on(rows)
    EnsembleNLLLoss(ensemble)(rows)["loss_dynamics"].backward()
    for member in range(3):
        alone = ensemble_on(rows, num_members=1)
        for ours, theirs in zip(alone.parameters(), ensemble.parameters()):
            ours.data = theirs.data[member : member + 1].clone()
        EnsembleNLLLoss(alone)(rows)["loss_dynamics"].backward()
        for ours, theirs in zip(alone.parameters(), ensemble.parameters()):
            torch.testing.assert_close(ours.grad[0], theirs.grad[member], rtol=1e-11, atol=1e-14)


def test_a_run_of_a_fleet_computes_what_it_computes_alone(make_rows):
    rows = make_rows(20, 3)
    fleet = ensemble_on(rows, num_runs=3)
    total = EnsembleNLLLoss(fleet, num_runs=3)(rows)["loss_dynamics"]
    total.backward()
    summed = 0.0
    for k in range(3):
        alone = select_run(fleet, k)
        loss = EnsembleNLLLoss(alone)(rows[:, k])["loss_dynamics"]
        loss.backward()
        summed += loss.item()
        for ours, theirs in zip(alone.parameters(), fleet.parameters()):
            torch.testing.assert_close(ours.grad, theirs.grad[k], rtol=1e-11, atol=1e-14)
    assert total.item() == pytest.approx(summed, rel=1e-13)


def test_no_gradient_crosses_runs(make_rows):
    rows = make_rows(20, 3)
    fleet = ensemble_on(rows, num_runs=3)
    EnsembleNLLLoss(fleet, num_runs=3)(rows)["loss_dynamics"].backward()
    before = [p.grad.clone() for p in fleet.parameters()]
    fleet.zero_grad()
    rows["next", "observation"][:, 1] += 1.0
    EnsembleNLLLoss(fleet, num_runs=3)(rows)["loss_dynamics"].backward()
    for old, new in zip(before, (p.grad for p in fleet.parameters())):
        assert torch.equal(old[[0, 2]], new[[0, 2]])
        assert not torch.equal(old[1], new[1])


def test_the_input_is_left_as_it_is(make_rows):
    rows = make_rows(20)
    before = rows.clone()
    EnsembleNLLLoss(ensemble_on(rows))(rows)
    assert set(rows.keys(True)) == set(before.keys(True))
    assert (rows == before).all()


def test_it_sees_the_statistics_that_the_ensemble_gathers_later(make_rows):
    rows, ensemble = make_rows(20), GaussianEnsemble(3, 2, 2, num_cells=(8,)).double()
    loss = EnsembleNLLLoss(ensemble)
    before = loss(rows)["loss_dynamics"].item()
    ensemble.update_statistics(rows)
    fresh = EnsembleNLLLoss(ensemble)(rows)["loss_dynamics"].item()
    assert loss(rows)["loss_dynamics"].item() == fresh != before


def test_moving_the_loss_moves_the_ensemble(make_rows):
    rows, ensemble = make_rows(20), GaussianEnsemble(3, 2, 2, num_cells=(8,)).double()
    parameters = list(ensemble.parameters())
    loss = EnsembleNLLLoss(ensemble).float()
    assert {p.dtype for p in ensemble.parameters()} == {torch.float32}
    assert {loss.ensemble_params["inputs", "mean"].dtype} == {ensemble.inputs.mean.dtype} == {torch.float64}
    assert all(a is b is c for a, b, c in zip(parameters, ensemble.parameters(), loss.parameters()))
    ensemble.update_statistics(rows.float())
    assert loss.ensemble_params["inputs", "count"].item() == 20


def test_rows_that_carry_a_graph_get_no_gradient(make_rows):
    rows, ensemble = make_rows(20), ensemble_on(make_rows(20))
    sources = []
    for key in ("observation", "action", "design", ("next", "observation")):
        sources.append(rows[key].clone().requires_grad_())
        rows[key] = sources[-1] * 1.0
    EnsembleNLLLoss(ensemble)(rows)["loss_dynamics"].backward()
    assert all(source.grad is None for source in sources)
    assert all(p.grad is not None for p in ensemble.parameters())


def test_a_change_over_several_steps_is_refused(make_rows):
    rows, loss = make_rows(20), EnsembleNLLLoss(ensemble_on(make_rows(20)))
    expected = loss(rows)["loss_dynamics"]
    rows["steps_to_next_obs"] = torch.ones(20, 1, dtype=torch.int64)
    assert loss(rows)["loss_dynamics"] == expected
    rows["steps_to_next_obs"][7] = 3
    with pytest.raises(ValueError, match="'steps_to_next_obs' is up to 3, 1 is needed here: train on rows of single"):
        loss(rows)


def test_a_state_dict_brings_weights_and_statistics_back(make_rows):
    rows = make_rows(20)
    loss, ensemble = EnsembleNLLLoss(ensemble_on(rows)), ensemble_on(make_rows(30, seed=1))
    other = EnsembleNLLLoss(ensemble)
    other.load_state_dict(loss.state_dict())
    assert loss(rows)["loss_dynamics"] == other(rows)["loss_dynamics"]
    assert ensemble.inputs.count.item() == 20


def test_it_can_be_called_with_tensors(make_rows):
    rows = make_rows(20)
    loss = EnsembleNLLLoss(ensemble_on(rows))
    by_name = loss(
        observation=rows["observation"],
        action=rows["action"],
        design=rows["design"],
        next_observation=rows["next", "observation"],
    )
    assert by_name == loss(rows)["loss_dynamics"]


def test_a_fleet_in_a_loss_without_runs_is_refused(make_rows):
    with pytest.raises(ValueError, match="num_runs=None, but GaussianEnsemble was built with num_runs=3"):
        EnsembleNLLLoss(GaussianEnsemble(3, 2, 2, num_cells=(8,), num_runs=3))
