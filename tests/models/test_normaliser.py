import pytest
import torch

from coim.models import RunningNormaliser


def test_merged_batches_have_the_statistics_of_all_rows():
    rows = torch.randn(100, 3, dtype=torch.float64) * torch.tensor([1.0, 10.0, 0.1]) + torch.tensor([0.0, 1e4, -5.0])
    normaliser = RunningNormaliser(3)
    for batch in rows.split([1, 40, 7, 52]):
        normaliser.update(batch)
    torch.testing.assert_close(normaliser.mean, rows.mean(0), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(normaliser.std, rows.std(0, correction=0), rtol=1e-9, atol=0)
    assert normaliser.count.item() == 100


def test_each_run_has_statistics_of_its_own():
    rows = torch.randn(4, 5, 2, 3, dtype=torch.float64)
    fleet, alone = RunningNormaliser(3, num_runs=2), RunningNormaliser(3)
    fleet.update(rows)
    alone.update(rows[:, :, 1])
    torch.testing.assert_close(fleet.mean[1], alone.mean)
    torch.testing.assert_close(fleet.std[1], alone.std)
    torch.testing.assert_close(fleet(rows)[:, :, 1], alone(rows[:, :, 1]))


@pytest.mark.parametrize("wrong", [float("nan"), float("inf")])
def test_a_number_that_is_none_is_refused_and_changes_nothing(wrong):
    normaliser = RunningNormaliser(3, num_runs=2)
    normaliser.update(torch.rand(5, 2, 3))
    before = {name: value.clone() for name, value in normaliser.state_dict().items()}
    rows = torch.rand(5, 2, 3)
    rows[4, 1, 2] = wrong
    with pytest.raises(ValueError, match=f"row 4 has {wrong} as feature 2; drop such rows"):
        normaliser.update(rows)
    assert all(torch.equal(value, before[name]) for name, value in normaliser.state_dict().items())


def test_rows_without_the_run_axis_in_its_place_are_refused():
    normaliser = RunningNormaliser(3, num_runs=2)
    with pytest.raises(ValueError, match=r"rows of shape \[2, 5, 3\] must end in \[2, 3\]"):
        normaliser.update(torch.zeros(2, 5, 3))
    assert normaliser.count.sum() == 0


def test_before_any_row_nothing_is_changed():
    x = torch.randn(4, 3)
    normaliser = RunningNormaliser(3)
    normaliser.update(torch.zeros(0, 3))
    assert torch.equal(normaliser(x), x)


def test_a_feature_that_never_varied_is_centred_but_not_scaled():
    normaliser = RunningNormaliser(2)
    normaliser.update(torch.tensor([[1.41, 0.0], [1.41, 2.0]]))
    assert normaliser.std.tolist() == [1.0, 1.0]
    torch.testing.assert_close(normaliser(torch.tensor([2.0, 3.0])), torch.tensor([0.59, 2.0]))


def test_the_standard_deviation_has_a_floor():
    normaliser = RunningNormaliser(2, min_std=torch.tensor([0.5, 0.0]))
    normaliser.update(torch.tensor([[1.0, 1.0], [1.02, 1.02]]))
    torch.testing.assert_close(normaliser.std, torch.tensor([0.5, 0.01], dtype=torch.float64), rtol=1e-4, atol=0)


def test_rounding_does_not_count_as_varying():
    normaliser = RunningNormaliser(1)
    for num in (1, 3, 7, 100, 1000):
        normaliser.update(torch.full((num, 1), 0.1, dtype=torch.float64))
    normaliser.square_sum += 1e-18  # what many merges may leave behind
    assert normaliser.std.tolist() == [1.0]


def test_a_feature_that_never_varied_is_scaled_by_its_floor_if_it_has_one():
    normaliser = RunningNormaliser(2, min_std=torch.tensor([0.5, 0.0]))
    normaliser.update(torch.ones(10, 2))
    assert normaliser.std.tolist() == [0.5, 1.0]


@pytest.mark.parametrize("move", [lambda n: n.to(torch.bfloat16), lambda n: n.half(), lambda n: n.float()])
def test_statistics_stay_exact_in_every_dtype(move):
    normaliser = move(RunningNormaliser(2, num_runs=3, min_std=torch.tensor([0.1, 0.0])))
    for _ in range(3):
        normaliser.update(torch.ones(1000, 3, 2, dtype=torch.bfloat16))
    assert normaliser.count.tolist() == [[3000.0]] * 3
    assert {buffer.dtype for buffer in normaliser.buffers()} == {torch.float64}
    assert normaliser(torch.ones(3, 2, dtype=torch.bfloat16)).dtype == torch.bfloat16


def test_statistics_move_to_another_device_as_one():
    normaliser = RunningNormaliser(2).to("meta", torch.bfloat16)
    assert {(buffer.device.type, buffer.dtype) for buffer in normaliser.buffers()} == {("meta", torch.float64)}
    with torch.device("meta"):
        normaliser = RunningNormaliser(2, min_std=torch.zeros(2, device="cpu"))
    assert {buffer.device.type for buffer in normaliser.buffers()} == {"meta"}
