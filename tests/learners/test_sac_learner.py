"""The SAC learner: what an update is, what `start_from` copies, and that runs do not meet."""

from __future__ import annotations

import io
from copy import deepcopy

import pytest
import torch
from torchrl.objectives import SoftUpdate
from toy_env import ToyEnv
from toy_learners import LR, Rows, give_noise, sac_learner, weights

from coim import CoImSACLoss, SACLearner, make_policy, make_qvalue, select_run


@pytest.mark.parametrize(("mix", "compile"), [("batch", False), ("sum", False), ("batch", True)])
def test_updates_equal_the_loss_adam_and_soft_update(make_rows: Rows, mix: str, compile: bool) -> None:
    learner = sac_learner(mix=mix, compile=compile)
    policy, qvalue = deepcopy(learner.policy), deepcopy(learner.qvalue)
    loss = CoImSACLoss(policy, qvalue, mix=mix)
    targets, optimiser = SoftUpdate(loss, tau=0.005), torch.optim.Adam(loss.parameters(), lr=3e-4)
    batches = make_rows(20, 32)
    batches["imagined"] = torch.zeros(20, 32, 1, dtype=torch.bool)
    batches["imagined"][:, 26:] = True

    learner.update(batches)

    rng = torch.Generator().manual_seed(0)
    noise = [torch.randn(20, 32, 2, generator=rng, dtype=torch.float64) for _ in range(2)]
    for i, batch in enumerate(batches):
        batch["noise"], batch["next", "noise"] = noise[0][i], noise[1][i]
        losses = loss(batch)
        optimiser.zero_grad()
        (losses["loss_actor"] + losses["loss_qvalue"]).backward()
        optimiser.step()
        targets.step()
    for key, value in loss.state_dict().items():
        torch.testing.assert_close(learner.loss.state_dict()[key], value, rtol=0, atol=1e-9)


def test_each_run_of_a_fleet_learns_what_it_would_learn_alone(make_rows: Rows) -> None:
    fleet = sac_learner(3)
    alone = [
        SACLearner(select_run(fleet.policy, k), select_run(fleet.qvalue, k), seed=0) for k in range(3)
    ]  # fmt: skip
    batches = make_rows(20, 16, 3)
    noise = [torch.randn(20, 16, 3, 2, dtype=torch.float64) for _ in range(2)]
    give_noise(fleet, noise)
    fleet.update(batches)
    for k, learner in enumerate(alone):
        give_noise(learner, [part[:, :, k] for part in noise])
        learner.update(batches[:, :, k])
        for network, own in ((fleet.policy, learner.policy), (fleet.qvalue, learner.qvalue)):
            for actual, expected in zip(select_run(network, k).parameters(), own.parameters(), strict=True):
                torch.testing.assert_close(actual, expected, rtol=0, atol=1e-9)


def test_compiled_float32_updates_of_a_fleet_equal_the_plain_ones(make_rows: Rows) -> None:
    """Also after alpha, gamma, tau and the learning rate were changed: none is a constant of what was compiled."""

    plain, quick = (sac_learner(3, dtype=torch.float32, compile=compile) for compile in (False, True))
    for seed in (0, 1):
        batches = make_rows(20, 16, 3, dtype=torch.float32, seed=seed)
        metrics, expected = quick.update(batches), plain.update(batches)
        for key, value in expected.items():
            torch.testing.assert_close(metrics[key], value, rtol=1e-5, atol=1e-6)
        for key, value in weights(plain).items():
            limit = 1e-5 * float(value.abs().max())
            torch.testing.assert_close(weights(quick)[key], value, rtol=0, atol=limit)
        for subject in (plain, quick):
            subject.loss.alpha, subject.loss.gamma, subject.tau = 0.5, 0.5, 0.25
            subject.optimiser.param_groups[0]["lr"] = 1e-3


def test_a_fleet_of_one_learns_as_a_single_run(make_rows: Rows) -> None:
    fleet, alone = sac_learner(1), sac_learner()
    for network, other in ((fleet.policy, alone.policy), (fleet.qvalue, alone.qvalue)):
        for own, given in zip(network.parameters(), other.parameters(), strict=True):
            own.data.copy_(given.data)
    fleet.start_from(fleet)
    batches = make_rows(3, 8, 1)
    expected = alone.update(batches.squeeze(-1))
    for key, value in fleet.update(batches).items():
        torch.testing.assert_close(value, expected[key], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("num_runs", "batch", "message"),
    [
        (2, (1, 2, 12), r"\[1, 2, 12\] needs num_runs=2 as its last dimension"),  # as a rollout is, [K, T]
        (2, (3, 4), r"\[3, 4\] needs num_runs=2"),
        (None, (3, 0), "has no rows"),
    ],
)
def test_rows_of_one_run_never_count_as_anothers(
    make_rows: Rows, num_runs: int | None, batch: tuple[int, ...], message: str
) -> None:
    learner = sac_learner(num_runs)
    before = weights(learner)
    with pytest.raises(ValueError, match=message):
        learner.update(make_rows(*batch))
    assert all(torch.equal(value, before[key]) for key, value in weights(learner).items())


@pytest.mark.parametrize(
    ("num_runs", "batch"), [(None, (12,)), (None, (12, 1)), (1, (12,)), (1, (12, 1)), (2, (12, 2))]
)
def test_what_a_buffer_samples_is_one_update(make_rows: Rows, num_runs: int | None, batch: tuple[int, ...]) -> None:
    flat, explicit = sac_learner(num_runs), sac_learner(num_runs)
    rows = make_rows(*batch)
    metrics, expected = flat.update(rows), explicit.update(rows.reshape(1, 12, num_runs or 1))
    assert (metrics == expected).all()
    assert [int(moments["step"]) for moments in flat.optimiser.state.values()] == [1]
    assert all(torch.equal(value, weights(explicit)[key]) for key, value in weights(flat).items())


@pytest.mark.parametrize("num_runs", [None, 1, 3])
def test_a_number_of_a_row_needs_no_dimension_of_its_own(make_rows: Rows, num_runs: int | None) -> None:
    learner, other, rows = sac_learner(num_runs), sac_learner(num_runs), make_rows(3, num_runs or 1)
    rows["imagined"] = torch.tensor([False, True, True]).reshape(3, 1, 1).expand(3, num_runs or 1, 1)
    expected = learner.update(rows)
    for key in ("imagined", ("next", "reward"), ("next", "terminated")):
        rows[key] = rows[key].squeeze(-1)
    assert (other.update(rows) == expected).all()


@pytest.mark.parametrize("set_to_none", [True, False])
def test_forgetting_the_gradients_changes_nothing(make_rows: Rows, set_to_none: bool) -> None:
    learner, other = sac_learner(), sac_learner()
    for subject in (learner, other):
        subject.update(make_rows(2, 8))
        if subject is learner:
            subject.optimiser.zero_grad(set_to_none=set_to_none)
        subject.update(make_rows(2, 8, seed=1))
    assert all(torch.equal(value, weights(other)[key]) for key, value in weights(learner).items())


def test_rows_that_only_the_loss_understands_are_refused(make_rows: Rows) -> None:
    learner, rows = sac_learner(), make_rows(8)
    rows["steps_to_next_obs"] = torch.ones(8, 1, dtype=torch.int64)
    learner.update(rows)
    rows["steps_to_next_obs"][3] = 5
    with pytest.raises(ValueError, match=r"'steps_to_next_obs' is up to 5, 1 is needed here.*CoImSACLoss"):
        learner.update(rows)
    with pytest.raises(ValueError, match=r"'priority_weight': .* train with CoImSACLoss, or exclude\(\) the key"):
        learner.update(make_rows(8).set("priority_weight", torch.ones(8)))
    for key in ("noise", ("next", "noise")):
        with pytest.raises(ValueError, match=r"noise'.*: SACLearner draws the policy's noise itself"):
            learner.update(make_rows(8).set(key, torch.ones(8, 1)))
    rows = make_rows(8)
    with pytest.raises(ValueError, match=r"is another design than 'design'.* cut the rows where bodies change"):
        learner.update(rows.set(("next", "design"), rows["design"] + 1))
    learner.loss.set_keys(priority="error")  # only written, by the loss
    learner.update(make_rows(8))
    learner.loss.set_keys(reward="pay")
    with pytest.raises(ValueError, match=r"by the keys of the schema, not by {'reward': 'pay'}; rename their entries"):
        learner.update(make_rows(8))


@pytest.mark.parametrize("num_runs", [None, 2])
def test_torchs_defaults_change_nothing(make_rows: Rows, num_runs: int | None) -> None:
    batches = make_rows(2, 8, *([num_runs] if num_runs else []), dtype=torch.float32)
    updated = []
    for device, dtype in (("cpu", torch.float32), ("meta", torch.float64)):
        torch.manual_seed(0)
        policy = make_policy(ToyEnv(), num_cells=(8,), num_runs=num_runs)
        qvalue = make_qvalue(ToyEnv(), num_cells=(8,), num_runs=num_runs)
        torch.set_default_dtype(dtype)
        try:
            with torch.device(device):
                learner = SACLearner(policy, qvalue, num_runs=num_runs, mix="sum")
                updated.append(dict(learner.update(batches).items()) | weights(learner))
                assert learner.loss(batches)["loss_actor"].dtype == torch.float32
        finally:
            torch.set_default_dtype(torch.float32)
    for key, value in updated[0].items():
        assert torch.equal(updated[1][key], value), key


@pytest.mark.parametrize("name", ["policy", "qvalue"])
def test_a_saved_network_is_that_network_alone(make_rows: Rows, name: str) -> None:
    def saved(state: dict[str, torch.Tensor]) -> int:
        file = io.BytesIO()
        torch.save(state, file)
        return len(file.getvalue())

    env = ToyEnv()
    networks = {"policy": make_policy(env), "qvalue": make_qvalue(env)}
    before = saved(networks[name].state_dict())
    learner = SACLearner(**networks)
    network = getattr(learner, name)
    assert saved(network.state_dict()) < 1.01 * before
    assert saved(deepcopy(network).state_dict()) < 1.01 * before
    for key, value in network.state_dict(keep_vars=True).items():
        assert torch.equal(value, network.state_dict()[key])
    start = {key: value.clone() for key, value in network.state_dict().items()}
    learner.update(make_rows(2, 8, dtype=torch.float32))
    network.load_state_dict(start)
    learner.update(make_rows(2, 8, dtype=torch.float32))  # they still lie in the flat buffer


@pytest.mark.parametrize("which", ["policy", "qvalue"])
def test_networks_that_were_moved_are_not_trained_in_silence(make_rows: Rows, which: str) -> None:
    learner = sac_learner()
    getattr(learner, which).float().double()
    with pytest.raises(RuntimeError, match=f"the {which} was moved after its learner was made; make the learner last"):
        learner.update(make_rows(1, 4))


def test_networks_of_two_dtypes_are_no_learner() -> None:
    policy, qvalue = make_policy(ToyEnv(), num_cells=(8,)), make_qvalue(ToyEnv(), num_cells=(8,)).double()
    with pytest.raises(ValueError, match=r"qvalue are torch\.float32 on cpu and torch\.float64 on cpu; move"):
        SACLearner(policy, qvalue)
    with pytest.raises(ValueError, match=r"qvalue are torch\.float32 on cpu and torch\.float32 on meta; move"):
        SACLearner(policy, qvalue.float().to("meta"))


def test_the_input_is_left_untouched(make_rows: Rows) -> None:
    batches = make_rows(2, 8)
    before = batches.clone()
    sac_learner().update(batches)
    assert set(batches.keys(True, True)) == set(before.keys(True, True))
    assert (batches == before).all()


def test_start_from_copies_weights_and_targets_and_forgets_the_moments(make_rows: Rows) -> None:
    population, individual = sac_learner(seed=1), sac_learner(seed=2)
    for learner in (population, individual):
        learner.update(make_rows(3, 8))
    individual.start_from(population)
    expected = weights(population)
    for key, value in weights(individual).items():
        assert torch.equal(value, expected[key]), key

    # The first step of a fresh Adam moves every weight that has a gradient by the learning rate, whatever came before.
    before = [p.clone() for p in individual.policy.parameters()]
    individual.update(make_rows(1, 8))
    moved = torch.cat([(p - b).abs().flatten() for p, b in zip(individual.policy.parameters(), before)])
    torch.testing.assert_close(moved[moved > 0].median(), torch.tensor(3e-4, dtype=torch.float64), rtol=1e-3, atol=0)
    for key, value in weights(population).items():
        assert torch.equal(value, expected[key]), key


def test_weights_that_mean_something_else_are_not_taken() -> None:
    learner, other = sac_learner(), sac_learner()
    other.policy.network.scaling.observation_scale.mul_(2.0)  # type: ignore[union-attr]
    before = weights(learner)
    with pytest.raises(ValueError, match="the two learners scale their inputs differently"):
        learner.start_from(other)
    learner.start_from(sac_learner(seed=1))
    before = weights(learner)
    with pytest.raises(ValueError, match="the Policy of one learner has weights of shapes"):
        learner.start_from(sac_learner(2))
    assert all(torch.equal(value, before[key]) for key, value in weights(learner).items())


def test_the_policy_that_acts_is_the_one_that_learns(make_rows: Rows) -> None:
    learner = sac_learner()
    observation, design = torch.ones(1, 3, dtype=torch.float64), torch.ones(1, 2, dtype=torch.float64)
    before = learner.policy.network(observation, design)[0].clone()
    learner.update(make_rows(2, 8))
    assert not torch.equal(learner.policy.network(observation, design)[0], before)


@pytest.mark.parametrize("num_runs", [None, 3])
def test_a_learner_goes_on_where_another_stood(make_rows: Rows, num_runs: int | None) -> None:
    shape = [num_runs] if num_runs else []
    one, other, fresh = (sac_learner(num_runs, seed=seed) for seed in (1, 2, 3))
    one.update(make_rows(3, 8, *shape, seed=1))
    other.update(make_rows(2, 8, *shape, seed=2))
    # A captured CUDA graph goes on reading and writing these very tensors.
    places = {key: value.data_ptr() for key, value in other.state_dict()["moments"].items()}
    state = deepcopy(one.state_dict())
    for learner in (other, fresh):
        learner.load_state_dict(state)
    assert {key: value.data_ptr() for key, value in other.state_dict()["moments"].items()} == places
    for learner in (one, other, fresh):
        learner.update(make_rows(3, 8, *shape, seed=4))
    for key, value in weights(one).items():
        assert torch.equal(weights(other)[key], value), key
        assert torch.equal(weights(fresh)[key], value), key


def test_a_learner_can_go_on_from_one_that_has_learnt_nothing(make_rows: Rows) -> None:
    untouched, used = sac_learner(seed=1), sac_learner(seed=2)
    used.update(make_rows(3, 8))
    used.load_state_dict(untouched.state_dict())
    for learner in (untouched, used):
        learner.update(make_rows(2, 8))
    for key, value in weights(untouched).items():
        assert torch.equal(weights(used)[key], value), key


@pytest.mark.gpu
@pytest.mark.parametrize("num_runs", [None, 3])
def test_a_gpu_ends_where_a_cpu_ends(make_rows: Rows, num_runs: int | None) -> None:
    """Twenty updates that are called, twenty captured and twenty replayed, each after a fresh start."""
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    learners = [sac_learner(num_runs, device=device, lr=LR) for device in ("cpu", "cuda")]
    on_cpu, on_gpu = learners
    for seed in (0, 1, 2):
        batches = make_rows(20, 32, *([num_runs] if num_runs else []), seed=seed)
        noise = [torch.randn_like(batches["action"]) for _ in range(2)]
        give_noise(on_cpu, noise)
        give_noise(on_gpu, [part.cuda() for part in noise])
        on_cpu.update(batches)
        on_gpu.update(batches.cuda())
        for learner in learners:
            learner.start_from(learner)
    for key, value in on_cpu.loss.state_dict().items():
        torch.testing.assert_close(on_gpu.loss.state_dict()[key].cpu(), value, rtol=0, atol=1e-9)
