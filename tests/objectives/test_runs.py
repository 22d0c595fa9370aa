import pytest
import torch
from tensordict import TensorDict
from torch import nn

from coim.objectives.runs import by_update, check_batch, check_num_runs, split_runs


def test_rows_are_split_by_run():
    rows = torch.arange(12.0).reshape(2, 3, 2)
    assert split_runs(rows, 2).shape == (6, 2)
    assert split_runs(rows, 2)[:, 1].tolist() == rows[..., 1].flatten().tolist()
    assert split_runs(rows, None).shape == (12, 1)


def test_a_batch_without_the_run_axis_is_refused():
    with pytest.raises(ValueError, match=r"size \[256\] needs num_runs=3 as its last dimension"):
        check_batch([256], 3)
    with pytest.raises(ValueError, match=r"size \[0\] has no rows"):
        check_batch([0], None)


def test_time_where_the_runs_must_be_is_refused_even_if_there_are_as_many_steps_as_runs():
    rollout = TensorDict(batch_size=[3, 3], names=["runs", "time"])
    with pytest.raises(ValueError, match=r"time is the last dimension of rows \[3, 3\], where the 3 runs must be"):
        by_update(rollout, 3)
    assert by_update(rollout.transpose(0, 1), 3).shape == (1, 3, 3)
    assert by_update(rollout[:1].transpose(0, 1), 1).shape == (1, 3, 1)


def test_networks_of_another_number_of_runs_are_refused():
    network = nn.Identity()
    check_num_runs(3, network)
    network.num_runs = 2
    with pytest.raises(ValueError, match="num_runs=3, but Identity was built with num_runs=2"):
        check_num_runs(3, network)


@pytest.mark.parametrize(
    ("num_runs", "given", "wanted"),
    [
        (None, [256], [1, 256, 1]),
        (None, [256, 1], [1, 256, 1]),  # as a buffer of one run samples them
        (None, [4, 64], [4, 64, 1]),
        (None, [1, 64], [1, 64, 1]),
        (None, [4, 1, 1], [4, 1, 1]),
        (1, [256], [1, 256, 1]),
        (1, [256, 1], [1, 256, 1]),
        (1, [4, 64, 1], [4, 64, 1]),
        (3, [256, 3], [1, 256, 3]),
        (3, [4, 64, 3], [4, 64, 3]),
    ],
)
def test_one_batch_is_one_update(num_runs, given, wanted):
    assert list(by_update(TensorDict(batch_size=given), num_runs).batch_size) == wanted


@pytest.mark.parametrize(
    ("num_runs", "given", "message"),
    [
        (
            None,
            [],
            r"size \[\] are no batches for num_runs=None: .* \[B, 1\], U of them take \[U, B, 1\]",
        ),
        (None, [4, 64, 3], r"size \[4, 64, 3\] are no batches for num_runs=None"),
        (1, [4, 64], r"\[4, 64\] needs num_runs=1 as its last dimension"),
        (3, [256], r"\[256\] needs num_runs=3 as its last dimension"),
        (3, [3, 64], r"\[3, 64\] needs num_runs=3 as its last dimension"),
        (3, [3], r"size \[3\] are no batches for num_runs=3: one update takes \[B, 3\]"),
        (3, [2, 2, 2, 3], r"size \[2, 2, 2, 3\] are no batches"),
        (None, [0], "has no rows"),
    ],
)
def test_what_is_no_batch_is_refused_by_its_shape(num_runs, given, message):
    with pytest.raises(ValueError, match=message):
        by_update(TensorDict(batch_size=given), num_runs)
