"""The dynamics learner: its updates are those of `EnsembleNLLLoss` and Adam, and its errors mean what they say."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from toy_env import ToyEnv

from coim import DynamicsLearner, EnsembleNLLLoss, GaussianEnsemble, select_run

Rows = Callable[..., TensorDict]


def ensemble_on(rows: TensorDict, *, dtype: torch.dtype = torch.float64, **kwargs: object) -> GaussianEnsemble:
    torch.manual_seed(0)
    ensemble = GaussianEnsemble.for_env(ToyEnv(), num_cells=(16, 16), **kwargs).to(dtype)  # type: ignore[arg-type]
    ensemble.update_statistics(rows)
    return ensemble


def learn_with_autograd(ensemble: GaussianEnsemble, batches: TensorDict) -> torch.Tensor:
    """What defines an update; returns the mean loss."""
    loss = EnsembleNLLLoss(ensemble)
    optimiser = torch.optim.Adam(loss.parameters(), lr=3e-4, weight_decay=1e-5)
    history = []
    for batch in batches:
        optimiser.zero_grad()
        history.append(loss(batch)["loss_dynamics"])
        history[-1].backward()
        optimiser.step()
    return torch.stack(history).detach().mean()


def assert_equal_weights(actual: GaussianEnsemble, expected: GaussianEnsemble, dtype: torch.dtype) -> None:
    """To 1e-9 in float64; in float32 to 1e-5 of the largest weight of the layer."""
    for ours, theirs in zip(actual.parameters(), expected.parameters(), strict=True):
        limit = 1e-9 if dtype == torch.float64 else 1e-5 * float(theirs.detach().abs().max())
        torch.testing.assert_close(ours, theirs, rtol=0, atol=limit)


@pytest.mark.parametrize(
    ("predict", "dtype", "compile"),
    [
        ("delta", torch.float64, False),
        ("next", torch.float64, False),
        ("delta", torch.float32, False),
        ("next", torch.float32, False),
        ("delta", torch.float32, True),
    ],
)
def test_updates_equal_the_loss_and_adam(make_rows: Rows, predict: str, dtype: torch.dtype, compile: bool) -> None:
    batches = make_rows(20, 32, dtype=dtype)
    ensemble = ensemble_on(batches, dtype=dtype, predict=predict)
    expected = deepcopy(ensemble)
    loss = DynamicsLearner(ensemble, compile=compile).update(batches)["loss_dynamics"]
    expected_loss = learn_with_autograd(expected, batches)
    torch.testing.assert_close(loss, expected_loss.reshape(1), rtol=1e-5, atol=0)
    assert_equal_weights(ensemble, expected, dtype)


def test_native_updates_take_rows_of_other_numbers(make_rows: Rows) -> None:
    rows = make_rows(20, 32, dtype=torch.float32)
    ensembles = [ensemble_on(make_rows(20, 32), dtype=torch.float64, predict="delta") for _ in range(2)]
    native, plain = (DynamicsLearner(one, compile=compile) for one, compile in zip(ensembles, (True, False)))
    losses = [one.update(rows)["loss_dynamics"].double() for one in (native, plain)]
    torch.testing.assert_close(*losses, rtol=1e-6, atol=0)
    assert (native.native, plain.native) == (True, False)
    assert_equal_weights(*ensembles, torch.float32)  # of what the rows were rounded to


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("predict", ["delta", "next"])
def test_each_run_of_a_fleet_learns_what_it_would_learn_alone(
    make_rows: Rows, predict: str, dtype: torch.dtype
) -> None:
    batches = make_rows(20, 32, 3, dtype=dtype)
    fleet = ensemble_on(batches, dtype=dtype, predict=predict, num_runs=3)
    alone = [select_run(fleet, k) for k in range(3)]
    losses = DynamicsLearner(fleet, num_runs=3).update(batches)["loss_dynamics"]
    for k, expected in enumerate(alone):
        expected_loss = learn_with_autograd(expected, batches[:, :, k])
        torch.testing.assert_close(losses[k], expected_loss, rtol=1e-5, atol=0)
        assert_equal_weights(select_run(fleet, k), expected, dtype)


@pytest.mark.parametrize("num_runs", [None, 2])
def test_bfloat16_products_keep_loss_and_weights_close(make_rows: Rows, num_runs: int | None) -> None:
    """To 0.05 % of the loss, and to 2 % of the way that the weights went in 20 updates."""
    batches = make_rows(20, 256, *(() if num_runs is None else (num_runs,)), dtype=torch.float32)
    start = ensemble_on(batches, dtype=torch.float32, num_runs=num_runs)
    exact, rounded = deepcopy(start), deepcopy(start)
    expected = DynamicsLearner(exact, num_runs=num_runs).update(batches)["loss_dynamics"]
    learner = DynamicsLearner(rounded, num_runs=num_runs, precision="bfloat16")
    loss = learner.update(batches)["loss_dynamics"]
    torch.testing.assert_close(loss, expected, rtol=5e-4, atol=0)
    flat = [torch.cat([p.detach().flatten() for p in e.parameters()]) for e in (start, exact, rounded)]
    assert (
        {p.dtype for p in rounded.parameters()} == {torch.float32} == {learner.loss(batches[0])["loss_dynamics"].dtype}
    )
    assert 0 < (flat[2] - flat[1]).norm() < 0.02 * (flat[1] - flat[0]).norm()


def test_a_restored_learner_goes_on_as_if_it_had_never_stopped(make_rows: Rows) -> None:
    batches = make_rows(2, 8)
    learner, other = DynamicsLearner(ensemble_on(batches)), DynamicsLearner(ensemble_on(make_rows(3, 9, seed=1)))
    learner.update(batches)
    other.loss.load_state_dict(learner.loss.state_dict())
    other.optimiser.load_state_dict(deepcopy(learner.optimiser.state_dict()))
    learner.update(batches)
    other.update(batches)
    for ours, theirs in zip(other.ensemble.parameters(), learner.ensemble.parameters(), strict=True):
        assert torch.equal(ours, theirs)
    assert learner.loss(batches[0])["loss_dynamics"] == other.loss(batches[0])["loss_dynamics"]


def test_weights_loaded_into_the_ensemble_are_those_that_learn_on(make_rows: Rows) -> None:
    batches = make_rows(2, 8)
    learner, start = DynamicsLearner(ensemble_on(batches)), ensemble_on(batches)
    learner.update(batches)
    learner.ensemble.load_state_dict(start.state_dict())
    learner.optimiser.state.clear()
    learner.update(batches)
    learn_with_autograd(start, batches)
    assert_equal_weights(learner.ensemble, start, torch.float64)


def test_the_input_is_left_untouched(make_rows: Rows) -> None:
    batches = make_rows(2, 8)
    before = batches.clone()
    DynamicsLearner(ensemble_on(batches)).update(batches)
    assert set(batches.keys(True, True)) == set(before.keys(True, True))
    assert (batches == before).all()


@pytest.mark.parametrize(
    ("num_runs", "batch"), [(None, (12,)), (None, (12, 1)), (1, (12,)), (1, (12, 1)), (2, (12, 2))]
)
def test_what_a_buffer_samples_is_one_update(make_rows: Rows, num_runs: int | None, batch: tuple[int, ...]) -> None:
    rows = make_rows(*batch)
    flat, explicit = (
        DynamicsLearner(ensemble_on(rows.reshape(12, num_runs or 1), num_runs=num_runs), num_runs=num_runs)
        for _ in range(2)
    )
    flat.optimiser.zero_grad()
    metrics, expected = flat.update(rows), explicit.update(rows.reshape(1, 12, num_runs or 1))
    assert (metrics == expected).all()
    assert [int(moments["step"]) for moments in flat.optimiser.state.values()] == [1]
    assert torch.equal(flat.state_dict()["weights"], explicit.state_dict()["weights"])


def test_torchs_defaults_change_nothing(make_rows: Rows) -> None:
    batches = make_rows(2, 8, dtype=torch.float32)
    updated = []
    for device, dtype in (("cpu", torch.float32), ("meta", torch.float64)):
        ensemble = ensemble_on(batches, dtype=torch.float32)
        torch.set_default_dtype(dtype)
        try:
            with torch.device(device):
                learner = DynamicsLearner(ensemble)
                learner.observe(batches)
                updated.append([learner.update(batches)["loss_dynamics"], learner.error(batches)])
                updated[-1].append(learner.loss(batches)["loss_dynamics"])
        finally:
            torch.set_default_dtype(torch.float32)
    for value, expected in zip(*updated, strict=True):
        assert value.dtype == torch.float32
        assert torch.equal(value, expected)


@pytest.mark.parametrize("name", ["update", "observe", "error"])
def test_a_change_over_several_steps_is_refused(make_rows: Rows, name: str) -> None:
    rows = make_rows(8, 1)
    learner = DynamicsLearner(ensemble_on(rows))
    rows["steps_to_next_obs"] = torch.ones(8, 1, 1, dtype=torch.int64)
    getattr(learner, name)(rows)
    rows["steps_to_next_obs"][3] = 5
    with pytest.raises(ValueError, match="'steps_to_next_obs' is up to 5, 1 is needed here"):
        getattr(learner, name)(rows)


def test_bad_input_is_named(make_rows: Rows) -> None:
    batches = make_rows(2, 8)
    with pytest.raises(ValueError, match="precision='float16' is unknown; choose 'float32' or 'bfloat16'"):
        DynamicsLearner(ensemble_on(batches), precision="float16")  # type: ignore[arg-type]
    learner = DynamicsLearner(ensemble_on(batches))
    with pytest.raises(ValueError, match="has no rows"):
        learner.update(batches[:0])
    with pytest.raises(ValueError, match="needs num_runs=3 as its last dimension"):
        DynamicsLearner(ensemble_on(make_rows(2, 8, 3), num_runs=3), num_runs=3).update(batches)
    fleet = DynamicsLearner(ensemble_on(make_rows(2, 8, 3), num_runs=3), num_runs=3)
    with pytest.raises(ValueError, match=r"\[3, 12\] needs num_runs=3 as its last dimension"):
        fleet.observe(make_rows(3, 12))  # as a rollout is, [K, T]
    with pytest.raises(RuntimeError, match="the ensemble was moved after its learner was made; make the learner last"):
        deepcopy(learner).update(batches)
    learner.ensemble.float()
    with pytest.raises(RuntimeError, match="the ensemble was moved after its learner was made; make the learner last"):
        learner.update(batches)


def test_the_ensemble_learns_and_its_error_falls(make_rows: Rows) -> None:
    torch.manual_seed(0)
    ensemble = GaussianEnsemble.for_env(ToyEnv(), num_members=2, num_cells=(32, 32)).double()
    learner = DynamicsLearner(ensemble, lr=3e-3)
    rows = make_rows(500, 1)
    learner.observe(rows)
    before = learner.error(rows)
    batches = rows[torch.randint(500, (300, 64), generator=torch.Generator().manual_seed(0))]
    first, last = (float(learner.update(part)["loss_dynamics"]) for part in (batches[:150], batches[150:]))
    assert before.shape == (1,)
    assert last < first
    assert float(learner.error(rows)) < 0.2 * float(before)


def test_predicting_no_change_scores_one() -> None:
    class Still:
        """Says that the next observation is this one."""

        def moments(self, observation: torch.Tensor, action: torch.Tensor, design: torch.Tensor) -> tuple:
            return observation.unsqueeze(-2), None

        def wrapped(self, x: torch.Tensor) -> torch.Tensor:
            return x

    learner = DynamicsLearner(GaussianEnsemble.for_env(ToyEnv(), num_cells=(8,)))
    learner.ensemble = Still()  # type: ignore[assignment]
    observation = torch.zeros(1000, 1, 3)
    following = torch.randn(1000, 1, 3, generator=torch.Generator().manual_seed(0))
    rows = TensorDict({"observation": observation, "action": observation, "design": observation}, [1000, 1])
    rows["next"] = TensorDict({"observation": following}, [1000, 1])
    torch.testing.assert_close(learner.error(rows), torch.ones(1), rtol=0, atol=0.01)
    torch.testing.assert_close(learner.error(rows.reshape(10, 100)), learner.error(rows))


def test_an_observation_that_stands_still_has_no_part_in_the_error(make_rows: Rows) -> None:
    """A target, say: what the ensemble is wrong by there is next to nothing, in no unit."""
    ensemble = GaussianEnsemble.for_env(ToyEnv(), num_members=2, num_cells=(8,)).double()
    learner = DynamicsLearner(ensemble)
    rows = make_rows(200, 1)
    for part in (rows, rows["next"]):
        part["observation"][..., -1] = 0.7
    learner.observe(rows)
    rest = ensemble.wrapped(rows["next", "observation"] - rows["observation"])[..., :-1].var(0, correction=0)
    means, _ = ensemble.moments(rows["observation"], rows["action"], rows["design"])
    wrong = (means - rows["next", "observation"].unsqueeze(-2)).square().mean((0, -2))[..., :-1]
    torch.testing.assert_close(learner.error(rows), (wrong / rest).mean(-1))
    rows["next", "observation"].copy_(rows["observation"])
    assert learner.error(rows).tolist() == [0]


@pytest.mark.gpu
@pytest.mark.parametrize("num_runs", [None, 3])
def test_a_gpu_ends_where_a_cpu_ends(make_rows: Rows, num_runs: int | None) -> None:
    """Three times twenty updates: called, captured and replayed."""
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    batches = make_rows(20, 16, *([num_runs] if num_runs else []))
    ensembles = []
    for device in ("cpu", "cuda"):
        torch.manual_seed(0)
        ensemble = ensemble_on(batches, num_runs=num_runs).to(device)
        # Exact in float32, in which a CUDA graph reads it.
        learner = DynamicsLearner(ensemble, num_runs=num_runs, lr=0.5**12)
        for _ in range(3):
            learner.update(batches)
        ensembles.append(ensemble.cpu())
    assert_equal_weights(ensembles[1], ensembles[0], torch.float64)


@pytest.mark.parametrize("num_runs", [None, 3])
def test_a_learner_goes_on_where_another_stood(make_rows: Rows, num_runs: int | None) -> None:
    batches = make_rows(3, 8, *([num_runs] if num_runs else []))
    one, other = (
        DynamicsLearner(
            GaussianEnsemble.for_env(ToyEnv(), num_cells=(16,), num_runs=num_runs).double(), num_runs=num_runs
        )
        for _ in range(2)
    )
    one.observe(batches[0])
    one.update(batches)
    other.load_state_dict(deepcopy(one.state_dict()))
    for learner in (one, other):
        learner.observe(batches[1])
        learner.update(batches)
    for key, value in one.ensemble.state_dict().items():
        assert torch.equal(other.ensemble.state_dict()[key], value), key
