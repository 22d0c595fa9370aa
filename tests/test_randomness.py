"""Generators go on from the state of their own kind, and are seeded by that of another kind of device."""

from __future__ import annotations

import torch

from coim.randomness import restore_generator

# What a GPU's generator saves: its seed and how far it is, eight bytes each.
OF_A_GPU = torch.tensor([5, 0, 0, 0, 0, 0, 0, 0, 12, 0, 0, 0, 0, 0, 0, 0], dtype=torch.uint8)


def drawn(state: torch.Tensor) -> list[int]:
    """Numbers that a CPU's generator gives after a state was restored."""
    generator = torch.Generator().manual_seed(99)
    restore_generator(generator, state)
    return torch.randint(2**31, (4,), generator=generator).tolist()


def test_a_state_of_the_same_kind_goes_on_where_it_was() -> None:
    saved = torch.Generator().manual_seed(3)
    torch.rand(5, generator=saved)
    state = saved.get_state()
    assert drawn(state) == torch.randint(2**31, (4,), generator=saved).tolist()


def test_a_state_that_is_a_view_of_a_larger_tensor_is_read_rightly() -> None:
    states = torch.stack([torch.Generator().manual_seed(seed).get_state() for seed in (1, 2)])
    assert drawn(states[1]) == drawn(torch.Generator().manual_seed(2).get_state())


def test_a_state_of_another_kind_of_device_seeds_the_same_numbers_each_time() -> None:
    further = OF_A_GPU.clone()
    further[8] += 4
    assert drawn(OF_A_GPU) == drawn(OF_A_GPU.clone())
    assert drawn(OF_A_GPU) != drawn(further)
