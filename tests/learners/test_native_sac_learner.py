"""Native updates of the SAC learner: those of the plain one, with every kind and setting of Adam."""

from __future__ import annotations

import pytest
import torch
from toy_learners import Rows, sac_learner, weights


def test_native_updates_take_batches_of_any_size(make_rows: Rows) -> None:
    native, plain = (sac_learner(compile=compile) for compile in (True, False))
    for updates, size in ((2, 32), (1, 1), (3, 31), (2, 32)):
        rows = make_rows(updates, size)
        native.update(rows)
        plain.update(rows)
        for key, value in weights(plain).items():
            torch.testing.assert_close(weights(native)[key], value, rtol=0, atol=1e-9)


@pytest.mark.parametrize("settings", [{}, {"weight_decay": 0.1}, {"weight_decay": 0.5, "decoupled_weight_decay": True}])
def test_native_updates_follow_the_settings_of_adam_and_count_its_steps(make_rows: Rows, settings: dict) -> None:
    native, plain = (sac_learner(compile=compile) for compile in (True, False))
    for learner in (native, plain):
        learner.optimiser.param_groups[0].update(settings, lr=1e-2, betas=(0.8, 0.95), eps=1e-4)
        learner.update(make_rows(60, 16))
        learner.optimiser.zero_grad()
        learner.update(make_rows(3, 16, seed=1))
    for key, value in weights(plain).items():
        torch.testing.assert_close(weights(native)[key], value, rtol=0, atol=1e-9)
    moments, expected = native.state_dict()["moments"], plain.state_dict()["moments"]
    assert moments.keys() == expected.keys()
    assert moments["step"] == 63
    for name, moment in expected.items():
        torch.testing.assert_close(moments[name], moment, rtol=0, atol=1e-9)


def test_who_looks_on_at_a_step_of_adam_sees_every_one_of_native_updates(make_rows: Rows) -> None:
    seen = []
    learner, alone = (sac_learner(compile=True) for _ in range(2))
    learner.optimiser.register_step_post_hook(lambda optimiser, *_: seen.append(float(optimiser.moments()["step"])))
    learner.update(make_rows(5, 16))
    alone.update(make_rows(5, 16))
    assert seen == [1, 2, 3, 4, 5]
    for key, value in weights(alone).items():
        torch.testing.assert_close(weights(learner)[key], value, rtol=0, atol=1e-9)
    scheduler = torch.optim.lr_scheduler.ExponentialLR(alone.optimiser, 0.5)
    alone.update(make_rows(5, 16))
    scheduler.step()  # warns, which is an error here, if it has seen no step
    assert alone.optimiser.param_groups[0]["lr"] == pytest.approx(1.5e-4)


def test_other_kinds_of_adam_step_after_native_gradients(make_rows: Rows) -> None:
    native, plain = (sac_learner(compile=compile) for compile in (True, False))
    for learner in (native, plain):
        learner.optimiser.param_groups[0]["amsgrad"] = True
        learner.update(make_rows(5, 16))
    for key, value in weights(plain).items():
        torch.testing.assert_close(weights(native)[key], value, rtol=0, atol=1e-9)


def test_native_updates_take_a_state_and_rows_of_other_numbers(make_rows: Rows) -> None:
    one = sac_learner(dtype=torch.float32)
    one.update(make_rows(3, 16, dtype=torch.float32))
    native, plain = (sac_learner(compile=compile) for compile in (True, False))
    for learner in (native, plain):
        learner.load_state_dict(one.state_dict())
        learner.rng.manual_seed(0)
    assert native.optimiser.moments()["exp_avg"].dtype == torch.float64
    rows = make_rows(3, 16)
    rows["next", "reward"] = rows["next", "reward"].float()
    for learner in (native, plain):
        learner.update(rows)
    for key, value in weights(plain).items():
        torch.testing.assert_close(weights(native)[key], value, rtol=0, atol=1e-9)


def test_native_targets_are_the_critics_where_tau_is_one(make_rows: Rows) -> None:
    learner = sac_learner(dtype=torch.float32, compile=True)
    learner.tau = 1.0
    learner.update(make_rows(3, 16, dtype=torch.float32))
    buffers = learner.state_dict()
    assert torch.equal(buffers["targets"], buffers["weights"][-len(buffers["targets"]) :])


def test_moments_of_another_length_are_refused(make_rows: Rows) -> None:
    learner = sac_learner(compile=True)
    learner.optimiser.moments()["exp_avg"] = torch.zeros(3, dtype=torch.float64)
    with pytest.raises(ValueError, match=r"exp_avg is \(3,\) of torch.float64, and "):
        learner.update(make_rows(3, 16))
