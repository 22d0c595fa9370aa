"""Random number generators: their states on other kinds of devices, and modules that only draw from torch's global one.

References:
    PyTorch: `torch.Generator <https://docs.pytorch.org/docs/stable/generated/torch.Generator.html>`_.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, get_args

import torch
from torch import Tensor

# A new one goes to the end, so that the numbers of all others stay what they are.
Stream = Literal[
    "actions",
    "dream",
    "designs",
    "individual",
    "population",
    "model",
    "imagined states",
    "imagined population",
    "imagined individual",
]
"""Everything that Algorithm 1 draws: actions, imagination, random designs, and the rows of each learner's batches."""

GLOBAL_GENERATORS = threading.RLock()
"""Held while torch's global generators, which are the process's, are changed for a while and then restored."""


def stream(name: Stream, seed: int, device: torch.device | str = "cpu") -> torch.Generator:
    """Make the generator of one thing that is drawn.

    Each has its own, so that no number depends on which is drawn first, or on whether another is drawn at all.

    Args:
        name: of what is drawn.
        seed: the same for all names.
        device: where the numbers are.

    Example:
        >>> one, other = stream("actions", 0), stream("designs", 0)
        >>> bool(torch.rand((), generator=one) == torch.rand((), generator=other))
        False
    """
    seeds = torch.Generator("cpu").manual_seed(seed)
    drawn = torch.randint(2**62, (get_args(Stream).index(name) + 1,), generator=seeds, device="cpu")
    return torch.Generator(device).manual_seed(int(drawn[-1]))


def restore_generator(generator: torch.Generator, state: Tensor) -> None:
    """Let a generator go on from a saved state.

    A state belongs to a kind of device: that of a CPU's generator is 5056 bytes, that of a GPU's 16. A generator of the
    kind that was saved goes on with the same numbers. One of another kind cannot, and is seeded by the saved bytes: its
    numbers are others, and the same ones each time that this state is restored.

    Args:
        generator: is changed in place.
        state: ``[bytes]`` uint8 of `torch.Generator.get_state`, on any device.

    Example:
        >>> saved, other = torch.Generator().manual_seed(0), torch.Generator()
        >>> restore_generator(other, saved.get_state())
        >>> torch.equal(torch.rand(3, generator=saved), torch.rand(3, generator=other))
        True
    """
    own = state.detach().cpu().clone()  # torch reads a view of a larger tensor wrongly
    if own.shape == generator.get_state().shape:
        generator.set_state(own)
    else:
        digest = hashlib.sha256(own.numpy().tobytes()).digest()
        generator.manual_seed(int.from_bytes(digest[:8], "big") >> 1)  # seeds are 63 bits and a sign


@contextmanager
def drawing_from(rng: torch.Generator | None, device: torch.device) -> Iterator[None]:
    """Let modules that can only draw from torch's global generator draw reproducibly, and leave it as it was.

    TorchRL's distributions take no generator. One thread at a time is inside: what it replaces is the process's, as is
    TorchRL's exploration type, which is set inside.

    Args:
        rng: gives the seed; None lets them draw from the global generator.
        device: on which they draw.

    Note:
        Another thread that draws from the global generator without this gets these numbers, and changes them.
    """
    with GLOBAL_GENERATORS:
        if rng is None:
            yield
            return
        shared = torch.default_generator if device.type == "cpu" else torch.cuda.default_generators[device.index or 0]
        before = shared.get_state()
        shared.manual_seed(int(torch.randint(2**62, (), generator=rng, device=rng.device)))
        try:
            yield
        finally:
            shared.set_state(before)
