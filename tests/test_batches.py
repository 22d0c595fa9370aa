"""Batches out of buffers: how many rows of which, drawn by whom."""

from __future__ import annotations

import pytest
import torch
from counted_rows import filled, keys_of, make_rows
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from coim.batches import BatchParts, batch_parts, sample_batches, sample_mixture
from coim.buffers import ROW_KEYS, TransitionBuffer


def mixed(
    real: TensorDictReplayBuffer, imagined: TensorDictReplayBuffer, share: float = 0.2, num_batches: int = 1
) -> TensorDict:
    """The population's batches (Sec. 5)."""
    parts = batch_parts(256, imagined=share)
    return sample_mixture([(real, parts.own), (imagined, parts.imagined)], num_batches, imagined=imagined)


def test_every_run_sees_its_own_rows_only() -> None:
    sample = sample_batches(filled(50, 3), batch_size=256)
    runs = sample["observation"].div(1000, rounding_mode="floor")
    assert sample.batch_size == (1, 256, 3)
    assert torch.equal(runs, torch.arange(3.0).view(1, 1, 3, 1).expand_as(runs))


def test_many_batches_are_drawn_uniformly_in_one_call() -> None:
    sample = sample_batches(filled(10), batch_size=200, num_batches=50)
    assert sample.batch_size == (50, 200, 1)
    counts = sample["observation"][..., 0].flatten().long().bincount(minlength=10)
    assert counts.sum() == 10_000
    assert (counts - 1000).abs().max() < 150  # five standard deviations


def test_a_buffer_draws_from_its_own_generator_and_from_nothing_else() -> None:
    before = torch.get_rng_state()
    draws = [sample_batches(filled(1000, seed=seed), batch_size=32)["observation"] for seed in (1, 1, 2)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])
    assert torch.equal(torch.get_rng_state(), before)


def test_the_default_mixture_is_205_real_and_51_imagined_rows_in_every_batch() -> None:
    real, imagined = filled(300, 2), filled(80, 2, first=500)
    batches = mixed(real, imagined, num_batches=7)
    assert batches.batch_size == (7, 256, 2)
    assert keys_of(batches) == {*ROW_KEYS, "imagined"}
    assert batches["imagined"].dtype == torch.bool
    assert batches["imagined"].sum((1, 3)).tolist() == [[51, 51]] * 7
    is_from_art = batches["observation"][..., :1] % 1000 >= 500
    assert torch.equal(batches["imagined"], is_from_art)


@pytest.mark.parametrize(("share", "expected"), [(0.0, 0), (1.0, 256), (0.5, 128), (0.1, 26)])
def test_a_share_is_rounded_to_rows(share: float, expected: int) -> None:
    assert mixed(filled(9), filled(9), share)["imagined"].sum() == expected


def test_a_buffer_without_a_share_may_be_empty() -> None:
    empty = TransitionBuffer(5, seed=0)
    assert not mixed(filled(9), empty, 0.0)["imagined"].any()
    assert mixed(empty, filled(9), 1.0)["imagined"].all()


def test_a_mixture_of_three_buffers_keeps_their_order_and_marks_one() -> None:
    ind, pop, art = filled(9), filled(9, first=100), filled(9, first=200)
    batch = sample_mixture([(ind, 3), (pop, 2), (art, 1)], 4, imagined=art)
    assert batch.batch_size == (4, 6, 1)
    assert (batch["observation"][0, :, 0, 0] // 100).tolist() == [0, 0, 0, 1, 1, 2]
    assert batch["imagined"][0, :, 0, 0].tolist() == [False] * 5 + [True]
    assert "imagined" not in sample_mixture([(ind, 3), (pop, 2)])


def test_stock_buffers_of_torchrl_can_be_mixed_too() -> None:
    stock = TensorDictReplayBuffer(storage=LazyTensorStorage(10))
    stock.extend(make_rows(10))
    assert mixed(stock, filled(9))["imagined"].sum() == 51


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan")])
def test_a_share_outside_of_0_to_1_is_refused(share: float) -> None:
    with pytest.raises(ValueError, match=rf"share is {share}, it must lie in \[0, 1\]"):
        batch_parts(256, imagined=share)


def test_a_batch_smaller_than_its_parts_is_refused() -> None:
    with pytest.raises(ValueError, match="a batch of 2 rows is smaller than its parts"):
        batch_parts(2, imagined=0.2)
    with pytest.raises(ValueError, match="need 13"):
        batch_parts(10, imagined=0.7, other=0.6)
    with pytest.raises(ValueError, match="a batch of 0 rows"):
        sample_mixture([(filled(9), 0)])
    with pytest.raises(ValueError, match="both numbers must be at least 1"):
        sample_batches(filled(9), batch_size=-1)


def test_an_empty_buffer_is_named_when_it_is_drawn_from() -> None:
    with pytest.raises(ValueError, match=r"36 rows are wanted of an empty buffer"):
        sample_batches(TransitionBuffer(5, seed=0), batch_size=36)


def test_batch_parts_of_the_paper() -> None:
    assert batch_parts(256, imagined=0.2) == BatchParts(own=205, other=0, imagined=51)
    assert batch_parts(256, other=0.1) == BatchParts(own=230, other=26, imagined=0)


@pytest.mark.parametrize(("size", "imagined", "other"), [(5, 0.5, 0.5), (3, 0.5, 0.5), (5, 0.3, 0.7), (256, 0.1, 0.9)])
def test_shares_that_are_the_whole_leave_no_row_to_a_third_part(size: int, imagined: float, other: float) -> None:
    parts = batch_parts(size, imagined=imagined, other=other)
    assert (parts.own, parts.imagined + parts.other) == (0, size)
    assert abs(parts.imagined - size * imagined) <= 0.5


def test_readers_with_generators_of_their_own_do_not_disturb_each_other() -> None:
    """What one reader gets does not depend on whether another one read before it."""
    buffer = filled(1000)

    def draw(*, other_first: bool) -> torch.Tensor:
        mine, other = (torch.Generator().manual_seed(seed) for seed in (1, 2))
        if other_first:
            sample_batches(buffer, rng=other)
        return sample_batches(buffer, rng=mine)["observation"]

    assert torch.equal(draw(other_first=True), draw(other_first=False))
