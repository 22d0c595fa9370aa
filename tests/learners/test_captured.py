"""Updates over one flat buffer. A recording of operators stands in for a CUDA graph: it, too, repeats what it saw."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten
from toy_learners import LR, dynamics_learner, sac_learner

import coim.learners.captured
from coim import DynamicsLearner, SACLearner

Rows = Callable[..., TensorDict]


class Recording(TorchDispatchMode):
    """Runs a function twice, and after that only the operators of the second time, on the very same tensors."""

    made: list[Recording] = []  # noqa: RUF012

    def __init__(self, function: Callable[..., Tensor], *, device: torch.device) -> None:
        super().__init__()
        self.function, self.device = function, device
        self.calls: list[tuple[Any, ...]] = []
        self.warm = False
        self.made.append(self)

    def __torch_dispatch__(self, operator: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = operator(*args, **(kwargs or {}))
        self.calls.append((operator, args, kwargs or {}, out))
        return out

    def __call__(self, *rows: Tensor) -> Tensor:
        if not self.warm:  # in the first call an optimiser makes its moments
            self.warm = True
            return self.function(*rows)
        if not self.calls:
            self.rows = [row.clone() for row in rows]
            with self:
                self.result = self.function(*self.rows)
            return self.result.clone()
        torch._foreach_copy_(self.rows, list(rows))
        for operator, args, kwargs, recorded in self.calls:
            for old, new in zip(tree_flatten(recorded)[0], tree_flatten(operator(*args, **kwargs))[0], strict=True):
                if isinstance(old, Tensor) and old.data_ptr() != new.data_ptr():
                    old.copy_(new)
        return self.result.clone()


@pytest.fixture
def recordings(monkeypatch: pytest.MonkeyPatch) -> list[Recording]:
    """Let learners on the CPU capture their updates, as those on CUDA do."""
    monkeypatch.setattr(Recording, "made", [])
    monkeypatch.setattr(coim.learners.captured, "Graph", Recording)
    monkeypatch.setattr(coim.learners.captured, "captures", lambda device: True)
    return Recording.made


def sac(device: str = "cpu") -> SACLearner:
    """A learner whose noise is the same on every device."""
    learner, rng = sac_learner(num_cells=(16,), device=device, lr=LR), torch.Generator().manual_seed(0)
    learner._noise = lambda action: torch.randn(  # type: ignore[method-assign]
        action.shape, generator=rng, dtype=action.dtype
    ).to(action.device)
    return learner


def dynamics(device: str = "cpu") -> DynamicsLearner:
    return dynamics_learner(num_cells=(16,), device=device, lr=LR)


def raise_the_rate(learner: Any) -> None:
    learner.optimiser.param_groups[0]["lr"] = 0.5**6


def schedule_the_rate(learner: Any) -> None:
    learner.optimiser.param_groups[0]["lr"] *= 1.0
    torch.optim.lr_scheduler.LambdaLR(learner.optimiser, lambda epoch: 0.25)


def forget_the_gradients(learner: Any) -> None:
    learner.optimiser.zero_grad()


def raise_the_betas(learner: Any) -> None:
    learner.optimiser.param_groups[0]["betas"] = (0.5, 0.9)


def forget_the_moments(learner: Any) -> None:
    learner.optimiser.state.clear()


def raise_alpha(learner: SACLearner) -> None:
    learner.loss.alpha = 0.5


def lower_gamma(learner: SACLearner) -> None:
    learner.loss.gamma = 0.5


def raise_tau(learner: SACLearner) -> None:
    learner.tau = 0.5


OF_BOTH = [raise_the_rate, schedule_the_rate, forget_the_gradients, raise_the_betas, forget_the_moments]
OF_SAC = [raise_alpha, lower_gamma, raise_tau]


EACH = [(make, change) for make in (sac, dynamics) for change in OF_BOTH]
EACH += [(sac, change) for change in OF_SAC]


def changed_midway(learner: Any, change: Any, batches: TensorDict) -> dict[str, Tensor]:
    """Weights, and targets of critics, after updates, a change and more updates: called, captured, replayed."""
    for _ in range(3):
        learner.update(batches[:5])
    before = learner.state_dict()["weights"].clone()
    change(learner)
    for _ in range(3):
        learner.update(batches[5:])
    state = learner.state_dict()
    assert not torch.equal(state["weights"], before)
    return {name: value.cpu() for name, value in state.items() if isinstance(value, Tensor) and name != "rng"}


@pytest.mark.parametrize(("make", "change"), EACH)
def test_a_captured_update_follows_what_is_changed_after_it(
    make_rows: Rows, recordings: list[Recording], monkeypatch: pytest.MonkeyPatch, make: Any, change: Any
) -> None:
    captured = changed_midway(make(), change, make_rows(10, 8))
    assert any(len(recording.calls) > 10 for recording in recordings)
    monkeypatch.undo()
    torch.testing.assert_close(captured, changed_midway(make(), change, make_rows(10, 8)), rtol=0, atol=1e-9)


@pytest.mark.gpu
@pytest.mark.parametrize(("make", "change"), EACH)
def test_a_cuda_graph_follows_what_is_changed_after_it(make_rows: Rows, make: Any, change: Any) -> None:
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    on_gpu, on_cpu = (changed_midway(make(device), change, make_rows(10, 8)) for device in ("cuda", "cpu"))
    torch.testing.assert_close(on_gpu, on_cpu, rtol=0, atol=1e-9)


@pytest.mark.parametrize("make", [sac, dynamics])
def test_updates_are_captured_once_on_the_device_of_the_weights(
    make_rows: Rows, recordings: list[Recording], make: Any
) -> None:
    learner = make()
    for rate in (1e-3, 1e-4, 1e-5):
        learner.optimiser.param_groups[0]["lr"] = rate
        learner.update(make_rows(3, 8))
    assert [recording.device for recording in recordings] == [torch.device("cpu")]


@pytest.mark.parametrize("make", [sac, dynamics])
def test_batches_of_another_size_are_captured_anew(make_rows: Rows, recordings: list[Recording], make: Any) -> None:
    learner = make()
    for size in (8, 8, 1, 1, 8):  # a graph's copy of its input would repeat the one row eight times
        learner.update(make_rows(3, size, 1))
    assert [recording.rows[0].shape[-2] for recording in recordings] == [8, 1]


@pytest.mark.parametrize("make", [sac, dynamics])
def test_many_updates_are_graphs_of_fifty_and_one_of_what_is_left(
    make_rows: Rows, recordings: list[Recording], monkeypatch: pytest.MonkeyPatch, make: Any
) -> None:
    batches = make_rows(120, 8)
    captured = make()
    found = [captured.update(batches) for _ in range(2)]
    assert [len(recording.rows[0]) for recording in recordings] == [50, 20]
    monkeypatch.undo()
    plain = make()
    expected = [plain.update(batches) for _ in range(2)]
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one.to_dict(), other.to_dict())
    assert torch.equal(captured.state_dict()["weights"], plain.state_dict()["weights"])


def test_updates_are_captured_on_cuda_alone() -> None:
    assert coim.learners.captured.captures(torch.device("cuda", 1))
    assert not coim.learners.captured.captures(torch.device("cpu"))
