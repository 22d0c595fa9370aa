"""Generators go on from the state of their own kind, and threads that draw at once do not see each other's numbers."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor

import torch

from coim.randomness import drawing_from, restore_generator

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


def drawn_globally(seed: int) -> list[float]:
    """Numbers of torch's global generator under a seed, with time for another thread to come between."""
    with drawing_from(torch.Generator().manual_seed(seed), torch.device("cpu")):
        first = torch.rand(()).item()
        time.sleep(0.02)
        return [first, torch.rand(()).item()]


def test_threads_that_draw_at_once_get_the_numbers_of_their_seeds_and_leave_the_global_generator_alone() -> None:
    alone, before = [drawn_globally(seed) for seed in range(3)], torch.get_rng_state()
    with ThreadPoolExecutor(3) as threads:
        assert list(threads.map(drawn_globally, range(3))) == alone
    assert torch.equal(torch.get_rng_state(), before)


def test_one_who_draws_may_ask_another_who_draws() -> None:
    with drawing_from(torch.Generator().manual_seed(0), torch.device("cpu")):
        between = drawn_globally(1)
        outer = torch.rand(()).item()
    assert [outer, *between] == [drawn_globally(0)[0], *drawn_globally(1)]
