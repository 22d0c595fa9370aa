import pytest
import torch
from torchrl.objectives import REDQLoss, SACLoss, SoftUpdate

from coim.models import make_policy, make_qvalue, select_run


@pytest.mark.parametrize("runs", [None, 3])
def test_critics_are_the_last_dimension(toy_env, make_rows, runs):
    rows = make_rows(5, *([] if runs is None else [runs]))
    qvalue = make_qvalue(toy_env, num_critics=4, num_cells=(8,), num_runs=runs).double()
    assert qvalue(rows)["state_action_value"].shape == (*rows.batch_size, 4)
    assert qvalue.num_runs == runs


def test_a_run_of_a_fleet_is_a_pair_of_critics_of_its_own(toy_env, make_rows):
    fleet, rows = make_qvalue(toy_env, num_cells=(8, 8), num_runs=3).double(), make_rows(5, 3)
    q = fleet(rows.clone())["state_action_value"]
    for k in range(3):
        alone = select_run(fleet, k)(rows[:, k].clone())["state_action_value"]
        torch.testing.assert_close(q[:, k], alone, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("as_list", [True, False])
@pytest.mark.parametrize("loss_class", [SACLoss, REDQLoss])
def test_our_networks_train_in_torchrls_own_losses(toy_env, make_rows, loss_class, as_list):
    policy = make_policy(toy_env, num_cells=(8,))
    critics = [make_qvalue(toy_env, num_critics=1, num_cells=(8,)) for _ in range(3)]
    loss = loss_class(policy, critics if as_list else critics[0], num_qvalue_nets=3, action_spec=toy_env.action_spec[0])
    SoftUpdate(loss, tau=0.005)
    out = loss(make_rows(6, dtype=torch.float32))
    (out["loss_actor"] + out["loss_qvalue"]).backward()
    trained = {name.split(".")[0] for name, p in loss.named_parameters() if p.grad is not None and p.grad.any()}
    assert {"actor_network_params", "qvalue_network_params"} <= trained
