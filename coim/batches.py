"""Batches out of replay buffers: many in one call, and put together from several buffers by exact numbers of rows.

Shapes: ``B`` rows of a batch, ``K`` runs.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Sec. 5 (80 % real, 20 % imagined).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer

ROUNDING = 1e-9  # of shares that are the rest of others


def sample_batches(
    buffer: TensorDictReplayBuffer,
    *,
    batch_size: int = 256,
    num_batches: int = 1,
    rng: torch.Generator | None = None,
) -> TensorDict:
    """Draw many batches in one call, uniformly and with replacement.

    Args:
        buffer: elements of batch size ``[K]``.
        batch_size: B, elements per batch.
        num_batches: batches drawn at once; fifty cost hardly more than one.
        rng: draws the rows, on the buffer's device; None takes the buffer's own generator. Readers that run at the same
            time need generators of their own, or who comes first decides what each of them gets.

    Returns:
        ``[num_batches, B, K]`` rows without TorchRL's ``index``.

    Raises:
        ValueError: if the buffer is empty or a number is below 1.

    Example:
        >>> from coim import HopperMorph, TransitionBuffer, transition_rows
        >>> buffer = TransitionBuffer(100, num_runs=1, seed=0)
        >>> _ = buffer.extend(transition_rows(HopperMorph(seed=0).rollout(20)).transpose(0, 1))
        >>> sample_batches(buffer, batch_size=32, num_batches=5).shape
        torch.Size([5, 32, 1])
    """
    if min(batch_size, num_batches) < 1:
        raise ValueError(f"{num_batches} batches of {batch_size} rows: both numbers must be at least 1")
    if len(buffer) == 0:
        raise ValueError(f"{batch_size} rows are wanted of an empty buffer; extend() it with transitions first")
    if rng is None:
        rows = buffer.sample(num_batches * batch_size)
    else:
        rows = buffer[torch.randint(len(buffer), (num_batches * batch_size,), generator=rng, device=rng.device)]
    return rows.exclude("index").unflatten(0, (num_batches, batch_size))


def sample_mixture(
    sources: Sequence[tuple[TensorDictReplayBuffer, int]],
    num_batches: int = 1,
    *,
    imagined: TensorDictReplayBuffer | None = None,
    rng: torch.Generator | None = None,
) -> TensorDict:
    """Draw batches that are put together from several buffers, each with its exact number of rows.

    (TorchRL's ``ReplayBufferEnsemble`` draws the buffers at random, so that its shares hold on average only.)

    Args:
        sources: buffers and the rows that each gives to a batch, in the order in which they appear there. A buffer that
            gives 0 rows may be empty.
        num_batches: batches drawn at once.
        imagined: which of the buffers holds imagined rows, Replay_Art; None writes no ``imagined``.
        rng: as for :func:`sample_batches`.

    Returns:
        ``[num_batches, B, K]`` rows, B the sum of all rows, with ``imagined`` ``[num_batches, B, K, 1]`` written.

    Raises:
        ValueError: if a buffer that is drawn from is empty, or there are no rows to draw.

    Example:
        >>> from coim.buffers import ROW_KEYS, TransitionBuffer
        >>> one, two = (TransitionBuffer(8, seed=0) for _ in range(2))
        >>> rows = TensorDict({key: torch.zeros(8, 1, 1) for key in ROW_KEYS}, [8, 1])
        >>> _ = one.extend(rows), two.extend(rows)
        >>> sample_mixture([(one, 2), (two, 1)], imagined=two)["imagined"].flatten()
        tensor([False, False,  True])
    """
    parts = []
    for buffer, num_rows in sources:
        if num_rows == 0:
            continue
        rows = sample_batches(buffer, batch_size=num_rows, num_batches=num_batches, rng=rng)
        if imagined is not None:
            flag = torch.full((*rows.batch_size, 1), buffer is imagined, device=rows["design"].device)
            rows.set("imagined", flag)
        parts.append(rows)
    if not parts:
        raise ValueError("a batch of 0 rows is asked for; let one of its sources give 1 or more")
    return parts[0] if len(parts) == 1 else torch.cat(parts, 1)


@dataclass(frozen=True)
class BatchParts:
    """Rows of one batch by where they come from."""

    own: int
    other: int
    imagined: int


def batch_parts(batch_size: int, *, imagined: float = 0.0, other: float = 0.0) -> BatchParts:
    """Whole rows for shares of a batch, as `sample_mixture` takes them.

    Args:
        batch_size: rows in all.
        imagined: share from Replay_Art, in [0, 1].
        other: share from a second real buffer, in [0, 1].

    Raises:
        ValueError: if a share leaves [0, 1], the shares need more rows than there are, or one is too small for a row.

    Example:
        >>> batch_parts(256, imagined=0.2)  # the population's, 80 % real and 20 % imagined (Sec. 5)
        BatchParts(own=205, other=0, imagined=51)
    """
    for name, share in (("imagined", imagined), ("other", other)):
        if not 0.0 <= share <= 1.0:
            raise ValueError(f"the {name} share is {share}, it must lie in [0, 1]")
    rows = round(batch_size * imagined), round(batch_size * other)
    if abs(1 - imagined - other) < ROUNDING:  # there is no third part that a rounded row could come from or go to
        rows = rows[0], batch_size - rows[0]
    own = batch_size - sum(rows)
    if own < 0:
        raise ValueError(f"shares {imagined} and {other} of a batch of {batch_size} rows need {sum(rows)}; lower them")
    wanted = (1 - imagined - other, own), (other, rows[1]), (imagined, rows[0])
    if any(share > ROUNDING and not count for share, count in wanted):
        raise ValueError(
            f"a batch of {batch_size} rows is smaller than its parts: shares {imagined} and {other} make it {own} + "
            f"{rows[1]} + {rows[0]} rows; enlarge the batch, or set a share to 0"
        )
    return BatchParts(own=own, other=rows[1], imagined=rows[0])


def put_imagined(
    batches: TensorDictBase,
    imagined: TensorDictReplayBuffer,
    num_rows: Tensor,
    *,
    rng: torch.Generator | None = None,
) -> TensorDictBase:
    """Put imagined rows in the place of the first rows of each batch, as many as each run may have.

    `sample_mixture` gives all runs the same share. Here a run with no imagined rows keeps its batch to the last bit,
    and nothing is drawn where no run has any.

    Args:
        batches: ``[num_batches, B, K]`` rows with ``imagined``, as of `sample_mixture`; left as they are.
        imagined: Replay_Art.
        num_rows: of each run, ``[K]``, at most B.
        rng: as for :func:`sample_batches`.

    Returns:
        ``[num_batches, B, K]`` rows.
    """
    most = int(num_rows.max())
    if most == 0:
        return batches
    drawn = sample_batches(imagined, batch_size=most, num_batches=len(batches), rng=rng)
    drawn.set("imagined", torch.ones_like(drawn["next", "terminated"]))
    place = torch.arange(most, device=drawn["design"].device)
    mask = place[:, None] < num_rows.to(place.device)  # [most, K]
    mixed = drawn.where(mask.expand(drawn.batch_size), batches[:, :most])
    return torch.cat([mixed, batches[:, most:]], 1)
