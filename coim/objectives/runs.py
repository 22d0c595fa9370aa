"""The run axis in a loss: a mean over the rows of each run, and a sum over runs.

Each run gets exactly the same gradient as when it is trained alone.

Shapes: ``U`` updates, ``B`` batch, ``K`` runs, ``R`` rows.
"""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import TensorDictBase
from torch import Tensor, nn


def check_num_runs(num_runs: int | None, *networks: nn.Module) -> None:
    """Refuse a loss and networks with different numbers of runs: the gradients would be scaled by 1 / K.

    Args:
        num_runs: ``K`` of the loss.
        networks: networks without a ``num_runs`` are not checked.

    Raises:
        ValueError: if the two differ; the message has the network.
    """
    for network in networks:
        runs = getattr(network, "num_runs", num_runs)
        if runs != num_runs:
            raise ValueError(
                f"num_runs={num_runs}, but {type(network).__name__} was built with num_runs={runs}; they must be equal"
            )


def check_batch(batch: Sequence[int], num_runs: int | None) -> None:
    """Refuse a batch, ``[*B, (K)]``, that has no rows or no run axis.

    Raises:
        ValueError: if the last dimension is not the run axis or there are no rows.
    """
    if num_runs is not None and (not batch or batch[-1] != num_runs):
        raise ValueError(f"a batch of size {list(batch)} needs num_runs={num_runs} as its last dimension")
    if 0 in batch:
        raise ValueError(f"a batch of size {list(batch)} has no rows; a mean needs at least one")


def check_runs_last(rows: TensorDictBase, num_runs: int | None) -> None:
    """Refuse rows ``[K, T]``, as a rollout returns them, if T equals K.

    Their shape does not differ from ``[B, K]``. The name that TorchRL gives to the time dimension does.

    Raises:
        ValueError: if the last dimension is time.
    """
    if num_runs is not None and num_runs > 1 and rows.batch_dims and rows.names[-1] == "time":
        raise ValueError(
            f"time is the last dimension of rows {list(rows.batch_size)}, where the {num_runs} runs must be; "
            "transpose(-2, -1) what env.rollout returns"
        )


def check_by_row(what: str, found: Sequence[int], batch: Sequence[int], wanted: str) -> None:
    """Refuse an output of a network with another batch shape than its input: rows would be paired wrongly.

    Args:
        what: name of the output, for the message.
        found: batch shape of the output.
        batch: batch shape of the input.
        wanted: full shape of the output, for the message.

    Raises:
        ValueError: if the two differ.
    """
    if list(found) != list(batch):
        raise ValueError(f"{what} must be {wanted} with *B = {list(batch)}, and are [*B, ...] with *B = {list(found)}")


def split_runs(rows: Tensor, num_runs: int | None) -> Tensor:
    """Reshape one number per row, ``[*B, (K)]``, to ``[R, K]``; ``[R, 1]`` without a run axis."""
    return rows.reshape(-1, num_runs or 1)


def by_update(rows: TensorDictBase, num_runs: int | None) -> TensorDictBase:
    """Reshape the batches of a learner to ``[U, B, K]``, with ``K = 1`` without a run axis.

    Args:
        rows: ``[B, K]``, one batch, or ``[U, B, K]``, one for each of U updates.  A single run may omit its axis:
            ``[B]``, and with ``num_runs=None`` ``[U, B]``, batches of two rows or more.
        num_runs: ``K`` of the learner, or None.

    Raises:
        ValueError: if the rows have another shape, or there are none.
    """
    size, runs = rows.batch_size, num_runs or 1
    if runs == 1 and (len(size) == 1 or (num_runs is None and len(size) == 2 and size[1] != 1)):
        rows = rows.unsqueeze(-1)
    check_batch(rows.batch_size, num_runs)
    check_runs_last(rows, num_runs)
    if rows.batch_dims == 2:
        rows = rows.unsqueeze(0)
    if rows.batch_dims != 3 or rows.batch_size[-1] != runs:
        raise ValueError(
            f"rows of batch size {list(size)} are no batches for num_runs={num_runs}: one update takes [B, {runs}], "
            f"U of them take [U, B, {runs}]"
        )
    return rows
