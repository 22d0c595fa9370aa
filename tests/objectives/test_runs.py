import pytest
import torch
from torch import nn

from coim.objectives.runs import check_batch, check_num_runs, split_runs


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


def test_networks_of_another_number_of_runs_are_refused():
    network = nn.Identity()
    check_num_runs(3, network)
    network.num_runs = 2
    with pytest.raises(ValueError, match="num_runs=3, but Identity was built with num_runs=2"):
        check_num_runs(3, network)
