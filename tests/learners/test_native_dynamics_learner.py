"""Native updates of the dynamics learner, which are those of the plain one; of both learners on several threads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from toy_learners import Rows, dynamics_learner, sac_learner

from coim import DynamicsLearner
from coim.learners import dynamics, sac
from coim.objectives import native_gradients
from coim.products import kind_of_processor


def weights_of(learner: DynamicsLearner) -> torch.Tensor:
    return torch.cat([part.detach().reshape(-1) for part in learner.ensemble.parameters()])


def seen(learner: DynamicsLearner, rows: TensorDict) -> DynamicsLearner:
    learner.observe(rows)
    return learner


@pytest.mark.parametrize("num_runs", [None, 1, 3])
def test_native_updates_take_batches_of_any_size(make_rows: Rows, num_runs: int | None) -> None:
    runs = () if num_runs is None else (num_runs,)
    native, plain = (
        seen(dynamics_learner(num_runs, compile=compile), make_rows(20, 32, *runs)) for compile in (True, False)
    )
    for updates, size in ((2, 32), (3, 31), (60, 2), (1, 300)):
        rows = make_rows(updates, size, *runs)
        losses = [learner.update(rows)["loss_dynamics"] for learner in (native, plain)]
        torch.testing.assert_close(*losses, rtol=1e-9, atol=0)
        torch.testing.assert_close(weights_of(native), weights_of(plain), rtol=0, atol=1e-9)


@pytest.mark.parametrize("settings", [{}, {"weight_decay": 0.1}, {"weight_decay": 0.5, "decoupled_weight_decay": True}])
def test_native_updates_follow_the_settings_of_adam_and_count_its_steps(make_rows: Rows, settings: dict) -> None:
    native, plain = (seen(dynamics_learner(compile=compile), make_rows(20, 32)) for compile in (True, False))
    for learner in (native, plain):
        learner.optimiser.param_groups[0].update(settings, lr=1e-2, betas=(0.8, 0.95), eps=1e-4)
        learner.update(make_rows(60, 16))
        learner.optimiser.zero_grad()
        learner.update(make_rows(3, 16, seed=1))
    torch.testing.assert_close(weights_of(native), weights_of(plain), rtol=0, atol=1e-9)
    moments, expected = native.state_dict()["moments"], plain.state_dict()["moments"]
    assert moments["step"] == 63
    for name, moment in expected.items():
        torch.testing.assert_close(moments[name], moment, rtol=0, atol=1e-9)


def test_who_looks_on_at_a_step_of_adam_sees_every_one_of_native_updates(make_rows: Rows) -> None:
    steps: list[float] = []
    learner, alone = (seen(dynamics_learner(compile=True), make_rows(20, 32)) for _ in range(2))
    learner.optimiser.register_step_post_hook(lambda optimiser, *_: steps.append(float(optimiser.moments()["step"])))
    losses = [one.update(make_rows(5, 16))["loss_dynamics"] for one in (learner, alone)]
    assert steps == [1, 2, 3, 4, 5]
    torch.testing.assert_close(*losses, rtol=1e-9, atol=0)
    torch.testing.assert_close(weights_of(learner), weights_of(alone), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "module", "counts"), [(dynamics_learner, dynamics, [16, 16, 16, 12]), (sac_learner, sac, [50, 10])]
)
def test_updates_are_native_as_a_whole_fifty_networks_in_a_call(
    make_rows: Rows, monkeypatch: pytest.MonkeyPatch, kind: Callable[..., Any], module: Any, counts: list[int]
) -> None:
    name = "dynamics_updates" if module is dynamics else "sac_updates"
    real, calls = getattr(module, name), []

    def told(*arguments: Any, **settings: Any) -> torch.Tensor:
        calls.append(len(losses := real(*arguments, **settings)))
        return losses

    monkeypatch.setattr(module, name, told)
    learner = kind(compile=True)
    learner.update(make_rows(60, 8))
    assert calls == counts
    learner.optimiser.register_step_post_hook(lambda *_: None)
    learner.update(make_rows(60, 8))
    assert calls == counts


@pytest.mark.parametrize(("kind", "module"), [(dynamics_learner, dynamics), (sac_learner, sac)])
def test_steps_of_a_call_that_fails_are_not_counted(
    make_rows: Rows, monkeypatch: pytest.MonkeyPatch, kind: Callable[..., Any], module: Any
) -> None:
    learner = kind(compile=True)
    learner.update(make_rows(2, 8))

    def full(*_: Any, **__: Any) -> torch.Tensor:
        raise MemoryError

    monkeypatch.setattr(module, "dynamics_updates" if module is dynamics else "sac_updates", full)
    with pytest.raises(MemoryError):
        learner.update(make_rows(4, 8))
    assert learner.optimiser.moments()["step"] == 2


def test_layers_that_leave_the_cache_are_learnt_as_others(make_rows: Rows, monkeypatch: pytest.MonkeyPatch) -> None:
    """Layers have more numbers than ``WIDE`` in ``native_networks.h``; rows fill a block, several, and a ragged one."""
    monkeypatch.setattr(native_gradients, "UP_TO_IN_ENSEMBLES", {kind_of_processor(): 512})
    native, plain = (
        seen(dynamics_learner(compile=compile, num_cells=(400, 400)), make_rows(20, 32)) for compile in (True, False)
    )
    assert native.native
    for size in (32, 300, 529):
        rows = make_rows(2, size)
        losses = [learner.update(rows)["loss_dynamics"] for learner in (native, plain)]
        torch.testing.assert_close(*losses, rtol=1e-9, atol=0)
        torch.testing.assert_close(weights_of(native), weights_of(plain), rtol=0, atol=1e-9)


@pytest.mark.parametrize("num_runs", [1, 2, 3])
@pytest.mark.parametrize("kind", [dynamics_learner, sac_learner])
def test_native_updates_have_the_same_bits_on_any_number_of_threads(
    make_rows: Rows, kind: Callable[..., Any], num_runs: int
) -> None:
    """Whether each takes networks of its own, all share one, or both by turns: 3 to 9 members, 1 to 3 runs."""
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 4):
            torch.set_num_threads(threads)
            learner = kind(num_runs, compile=True, num_cells=(37, 20), dtype=torch.float32)
            losses = learner.update(make_rows(7, 150, num_runs, dtype=torch.float32))
            found.append([*losses.values(), *learner.weights_by_run(), *learner.moments_by_run()])
    finally:
        torch.set_num_threads(before)
    for others in found[1:]:
        for one, other in zip(found[0], others, strict=True):
            assert torch.equal(one, other)
