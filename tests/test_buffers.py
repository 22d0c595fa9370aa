"""The four buffers.  T time steps, B batch, K runs, S state, A action, D design."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
import torch
from counted_rows import filled, keys_of, make_rows
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.envs import EnvBase, RewardScaling

from coim.batches import sample_batches
from coim.buffers import (
    ROW_KEYS,
    Buffers,
    TransitionBuffer,
    transition_rows,
)

CHEETAH = {"S": 17, "D": 6, "A": 6}


def test_transition_rows_keep_the_schema_and_leave_the_input_alone() -> None:
    transitions = make_rows(3).set("sample_log_prob", torch.zeros(3, 1)).set("step_count", torch.zeros(3, 1, 1))
    before = keys_of(transitions)
    rows = transition_rows(transitions)
    assert keys_of(rows) == set(ROW_KEYS)
    assert keys_of(transitions) == before
    assert rows["observation"] is transitions["observation"]


def test_transitions_without_a_design_are_refused() -> None:
    with pytest.raises(ValueError, match=r"lack \['design', \('next', 'design'\)\]"):
        transition_rows(make_rows(3).exclude("design", ("next", "design")))


def test_a_buffer_stores_the_schema_and_nothing_else() -> None:
    buffer = TransitionBuffer(10, num_runs=2, seed=0)
    rows = make_rows(4, 2).set("sample_log_prob", torch.zeros(4, 2))
    buffer.extend(rows)
    assert "index" not in rows
    assert keys_of(buffer.sample(8).exclude("index")) == set(ROW_KEYS)


def test_emptying_and_refilling_keeps_the_storage_and_shows_new_rows_only() -> None:
    art = filled(100, capacity=100)
    place = art.storage[:]["observation"].data_ptr()
    art.empty()
    assert len(art) == 0
    art.extend(make_rows(40, first=500))
    assert len(art) == 40
    assert art.storage[:]["observation"].data_ptr() == place
    assert sample_batches(art, batch_size=500)["observation"].min() >= 500


def test_a_full_buffer_forgets_its_oldest_rows() -> None:
    buffer = filled(8, capacity=10)
    buffer.extend(make_rows(5, first=100))
    assert sorted(buffer[:]["observation"][:, 0, 0].tolist()) == [3, 4, 5, 6, 7, 100, 101, 102, 103, 104]


def test_six_and_a_half_million_cheetah_rows_fit_into_one_and_a_half_gigabytes() -> None:
    buffer = TransitionBuffer(1000, seed=0)
    buffer.extend(make_rows(1, **CHEETAH))
    bytes_per_row = buffer.storage._storage.bytes() / 1000
    assert bytes_per_row == 4 * (17 + 6 + 6 + 17 + 6 + 1) + 3
    assert bytes_per_row <= 1.5e9 / 6.5e6


def test_the_buffers_of_an_environment_share_its_runs_but_not_their_draws() -> None:
    env = cast(EnvBase, SimpleNamespace(batch_size=torch.Size([3])))
    buffers = Buffers.for_env(env, pop_capacity=40, ind_capacity=30, s0_capacity=20, art_capacity=10, seed=0)
    each = [buffers.pop, buffers.ind, buffers.s0, buffers.art]
    assert [buffer.capacity for buffer in each] == [40, 30, 20, 10]
    for buffer in each:
        buffer.extend(make_rows(10, 3))
    draws = [sample_batches(buffer, batch_size=32)["observation"] for buffer in each]
    assert not any(torch.equal(draws[i], draws[j]) for i in range(4) for j in range(i))


def test_a_checkpoint_holds_the_filled_rows_and_sampling_goes_on(tmp_path: Path) -> None:
    def make(seed: int) -> Buffers:
        env = cast(EnvBase, SimpleNamespace(batch_size=torch.Size([2])))
        return Buffers.for_env(env, pop_capacity=10, ind_capacity=10**6, s0_capacity=5, art_capacity=5, seed=seed)

    buffers, resumed = make(0), make(1)
    buffers.pop.extend(make_rows(8, 2))
    buffers.pop.extend(make_rows(5, 2, first=100))  # past the end: the oldest row is in the middle
    buffers.ind.extend(make_rows(3, 2))
    resumed.ind.extend(make_rows(7, 2, first=300))
    sample_batches(buffers.pop)
    Checkpoint(buffers=buffers).save(tmp_path / "run")
    assert sum(file.stat().st_size for file in tmp_path.rglob("*") if file.is_file()) < 10**5
    Checkpoint(buffers=resumed).load(tmp_path / "run")
    for buffer, other in ((buffers.pop, resumed.pop), (buffers.ind, resumed.ind)):
        buffer.extend(make_rows(1, 2, first=200))
        other.extend(make_rows(1, 2, first=200))
        assert (buffer[:].exclude("index") == other[:].exclude("index")).all()
        assert (sample_batches(buffer) == sample_batches(other)).all()
    assert len(resumed.art) == 0


def test_a_checkpoint_of_a_buffer_that_transforms_what_it_samples_holds_what_is_stored() -> None:
    def made(seed: int) -> TransitionBuffer:
        buffer = TransitionBuffer(9, num_runs=2, seed=seed)
        buffer.append_transform(RewardScaling(0.0, 10.0, in_keys=[("next", "reward")]))
        return buffer

    buffer, resumed = made(0), made(1)
    buffer.extend(make_rows(8, 2))
    resumed.load_state_dict(buffer.state_dict())
    assert torch.equal(buffer.state_dict()["rows"]["next.reward"], make_rows(8, 2)["next", "reward"])
    assert torch.equal(resumed.state_dict()["rows"]["next.reward"], make_rows(8, 2)["next", "reward"])
    assert torch.equal(resumed.sample(20)["next", "reward"], buffer.sample(20)["next", "reward"])


def test_one_time_step_is_stored_as_many_are() -> None:
    buffer = TransitionBuffer(5, num_runs=2, seed=0)
    buffer.extend(make_rows(3, 2))
    assert buffer.add(make_rows(1, 2, first=7.0)[0].set("step_count", torch.zeros(2, 1))) == 3
    assert keys_of(buffer[:]) == set(ROW_KEYS)
    assert buffer[:]["observation"][3, :, 0].tolist() == [7.0, 1007.0]
    with pytest.raises(ValueError, match=r"lack \['design'\]"):
        buffer.add(make_rows(1, 2)[0].exclude("design"))
    with pytest.raises(ValueError, match=r"batch size \[1\], \[T, 2\] is needed"):
        buffer.add(make_rows(1)[0, 0])
    assert len(buffer) == 4


@pytest.mark.parametrize("named", [True, False])
def test_a_rollout_with_as_many_steps_as_runs_is_not_taken_for_time_first(toy_env: EnvBase, named: bool) -> None:
    env = type(toy_env)(num_runs=3, episode_steps=9)  # type: ignore[call-arg]
    rollout, buffer = env.rollout(3), TransitionBuffer(9, num_runs=3, seed=0)
    if not named:
        rollout = TensorDict(rollout.to_dict(), [3, 3])
    with pytest.raises(ValueError, match=r"time is the last dimension of rows \[3, 3\]"):
        buffer.extend(rollout)
    buffer.extend(rollout.transpose(0, 1))
    assert torch.equal(buffer[:]["observation"][:, 0], rollout["observation"][0])


def test_one_step_of_all_runs_is_no_episode_of_one(toy_env: EnvBase) -> None:
    rollout = type(toy_env)(num_runs=3, episode_steps=9).rollout(3)  # type: ignore[call-arg]
    with pytest.raises(ValueError, match="time is the last dimension"):
        TransitionBuffer(9, num_runs=3, seed=0).add(rollout[0])


def test_stored_rows_have_no_graph() -> None:
    rows, buffer = make_rows(3), TransitionBuffer(9, seed=0)
    rows["action"] = torch.ones(3, 1, 1, requires_grad=True) * 2
    buffer.extend(rows)
    buffer.add(rows[0])
    assert not any(value.requires_grad for value in buffer[:].values(True, True))
    assert rows["action"].requires_grad  # what was given keeps its graph


def test_an_entry_without_a_dimension_of_its_own_is_refused() -> None:
    rows = make_rows(3, 2)
    rows["next", "reward"] = torch.zeros(3, 2)
    with pytest.raises(ValueError, match=r"\('next', 'reward'\) has shape \[3, 2\]"):
        transition_rows(rows)


def test_buffers_do_not_depend_on_torchs_default_device() -> None:
    def draw() -> torch.Tensor:
        env = cast(EnvBase, SimpleNamespace(batch_size=torch.Size([1])))
        buffers = Buffers.for_env(env, pop_capacity=9, ind_capacity=9, s0_capacity=9, art_capacity=9, seed=0)
        buffers.pop.extend(rows)
        return buffers.pop.sample(20)["observation"]

    rows = make_rows(9)
    expected = draw()
    with torch.device("meta"):
        assert torch.equal(draw(), expected)


def test_rows_that_do_not_fit_are_refused() -> None:
    buffer = TransitionBuffer(5, num_runs=2, seed=0)
    with pytest.raises(ValueError, match=r"\[2, 4\], \[T, 2\] is needed"):
        buffer.extend(make_rows(2, 4))
    with pytest.raises(ValueError, match="6 rows do not fit into a buffer of 5"):
        buffer.extend(make_rows(6, 2))
    with pytest.raises(ValueError, match="a buffer of 0 rows"):
        TransitionBuffer(0, seed=0)


def test_a_state_that_does_not_fit_changes_nothing() -> None:
    def make(capacity: int, num_runs: int = 1) -> Buffers:
        sizes = {"pop_capacity": capacity, "ind_capacity": 9, "s0_capacity": 9, "art_capacity": 9}
        return Buffers.for_env(cast(EnvBase, SimpleNamespace(batch_size=torch.Size([num_runs]))), **sizes, seed=0)

    small, large = make(5), make(12)
    for buffers in (small, large):
        buffers.ind.extend(make_rows(2, first=float(buffers.pop.capacity)))
    large.pop.extend(make_rows(12))
    with pytest.raises(ValueError, match=r"holds 12 rows of 1 run\(s\), this buffer has room for 5 of 1"):
        small.load_state_dict(large.state_dict())
    assert small.ind[:]["observation"][0, 0, 0] == 5
    with pytest.raises(ValueError, match=r"12 rows of 1 run\(s\), this buffer has room for 12 of 2"):
        make(12, num_runs=2).load_state_dict(large.state_dict())


@pytest.mark.parametrize(("stored", "capacity"), [(4, 9), (6, 9), (8, 9), (8, 6), (4, 6)])
def test_a_larger_buffer_goes_on_behind_the_newest_row(stored: int, capacity: int) -> None:
    small, large = TransitionBuffer(6, seed=0), TransitionBuffer(capacity, seed=1)
    for t in range(stored):
        small.extend(make_rows(1, first=float(t)))
    large.load_state_dict(small.state_dict())
    large.extend(make_rows(1, first=100.0))
    assert sorted(large[:]["observation"][:, 0, 0].tolist()) == [
        *range(max(0, stored - 6, stored - capacity + 1), stored),
        100.0,
    ]
