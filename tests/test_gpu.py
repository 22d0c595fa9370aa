"""What must hold on a GPU: graphs compute what eager code does, episodes are the CPU's, runs move between devices."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from itertools import islice
from typing import Any

import pytest
import torch
from small_algorithm import small
from tensordict import TensorDict
from toy_learners import dynamics_learner, sac_learner

from coim import (
    CoAdaptation,
    DesignChosen,
    DynamicsLearner,
    EpisodeDone,
    HopperMorph,
    SACLearner,
    make_policy,
    run_episode,
)

pytestmark = pytest.mark.gpu
Rows = Callable[..., TensorDict]


def sac() -> SACLearner:
    """On the GPU, the same each time."""
    return sac_learner(3, device="cuda")


def dynamics() -> DynamicsLearner:
    """On the GPU, the same each time."""
    return dynamics_learner(3, device="cuda")


def saved(algorithm: CoAdaptation) -> Mapping[str, Any]:
    """The state as it comes back from a file on a machine without a GPU."""
    file = io.BytesIO()
    torch.save(algorithm.state_dict(), file)
    file.seek(0)
    return torch.load(file, map_location="cpu", weights_only=True)


@pytest.mark.parametrize("make", [sac, dynamics])
def test_an_update_by_a_captured_graph_is_the_eager_one(
    make: Callable[[], Any], make_rows: Rows, monkeypatch: pytest.MonkeyPatch
) -> None:
    batches = make_rows(70, 32, 3).cuda()  # a graph of fifty updates, and one of twenty
    captured = make()
    with monkeypatch.context() as patched:
        patched.setattr("coim.learners.captured.captures", lambda device: False)
        eager = make()
        for _ in range(3):
            eager.update(batches)
    for _ in range(3):  # called, captured, replayed
        captured.update(batches)
    for one, other in zip(captured.weights_by_run(), eager.weights_by_run(), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-7)


def test_an_episode_is_that_of_the_cpu_to_rounding() -> None:
    episodes = []
    for device in ("cpu", "cuda"):
        env = HopperMorph(num_runs=3, episode_steps=40, seed=0, device=device)
        torch.manual_seed(0)
        policy = make_policy(HopperMorph(seed=0), num_runs=3).to(device)
        episodes.append(run_episode(env, policy, rng=torch.Generator().manual_seed(0)))
    on_cpu, on_gpu = episodes
    assert on_gpu["observation"].device.type == "cuda"
    for key in on_cpu.keys(include_nested=True, leaves_only=True):
        torch.testing.assert_close(on_gpu[key].cpu(), on_cpu[key], rtol=0, atol=1e-3)


@pytest.mark.parametrize("num_runs", [1, 2])
def test_the_replay_may_stay_on_the_cpu(num_runs: int) -> None:
    algorithm, on_cpu = (small(num_runs, device=device, replay="cpu") for device in ("cuda", "cpu"))
    events, expected = list(algorithm), list(on_cpu)
    assert all(getattr(algorithm.buffers, name).storage.device.type == "cpu" for name in ("pop", "ind", "s0", "art"))
    assert algorithm.population.weights_by_run()[0].device.type == "cuda"
    assert [type(event) for event in events] == [type(event) for event in expected]
    chosen = [event for event in events if isinstance(event, DesignChosen)]
    assert all(event.predicted.device.type == "cpu" for event in chosen[1:])
    # The random bodies and the first episode are drawn on the CPU: they are the same ones.
    assert torch.equal(chosen[3].design.cpu(), next(e for e in expected if e.kind == "random").design)
    first, other = (next(e for e in found if isinstance(e, EpisodeDone)) for found in (events, expected))
    torch.testing.assert_close(first.training_return, other.training_return, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("begun_on", "gone_on_with"), [("cuda", "cpu"), ("cpu", "cuda")])
def test_a_run_goes_on_where_there_is_another_device(begun_on: str, gone_on_with: str) -> None:
    first = small(device=begun_on)
    events = list(islice(first, 8))
    state = saved(first)
    ends = []
    for _ in range(2):
        second = small(device=gone_on_with)
        second.load_state_dict(state)
        for one, other in zip(second.population.weights_by_run(), first.population.weights_by_run(), strict=True):
            assert torch.equal(one.cpu(), other.cpu())
        assert torch.equal(second.buffers.pop[:]["action"].cpu(), first.buffers.pop[:]["action"].cpu())
        ends.append(list(second))
    assert len(events) + len(ends[0]) == len(list(small()))
    # The saved bytes seed what cannot go on: each time the same numbers.
    returns = [[float(e.training_return) for e in found if isinstance(e, EpisodeDone)] for found in ends]
    assert returns[0] == pytest.approx(returns[1], rel=1e-3, abs=1e-3)
