"""The four replay buffers of Algorithm 1 and their common schema.

Shapes: ``T`` time steps (rows of a buffer), ``B`` any batch, ``K`` runs, ``S`` state, ``A`` action, ``D`` design.

A buffer is TorchRL's, with one element per time step. An element is ``[K]``-batched: a sample of B elements is
``[B, K]`` and a run only ever sees its own rows. The same time steps are drawn for all runs.

References:
    Co-Imagination of Behaviour and Morphology of Agents: Sec. 5, Algorithm 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, RandomSampler, RoundRobinWriter, TensorDictReplayBuffer
from torchrl.envs import EnvBase

from coim.randomness import restore_generator

ROW_KEYS: tuple[NestedKey, ...] = (
    "observation",  # [*B, S] f32, s_t without the design
    "design",  # [*B, D] f32, xi
    "action",  # [*B, A] f32 in [-1, 1], a_t
    ("next", "observation"),  # [*B, S] f32, s_{t+1}
    ("next", "design"),  # [*B, D] f32, equal to `design`
    ("next", "reward"),  # [*B, 1] f32
    ("next", "terminated"),  # [*B, 1] bool, the only one that cuts the bootstrap
    ("next", "truncated"),  # [*B, 1] bool
    ("next", "done"),  # [*B, 1] bool
)
"""What a stored row consists of, in all four buffers."""


def transition_rows(transitions: TensorDictBase) -> TensorDict:
    """Keep of transitions what a buffer stores.

    Args:
        transitions: stepped tensordict, rollout or collector batch ``[*B]`` with at least :data:`ROW_KEYS`; anything
            else in it (log-probabilities, step counts) is dropped.

    Returns:
        The rows, ``[*B]``, in a tensordict of their own; the tensors are shared with ``transitions``.

    Raises:
        ValueError: if an entry of the schema is missing, or has not one dimension more than the batch.

    Example:
        >>> from coim import HopperMorph
        >>> rollout = HopperMorph(seed=0).rollout(5)
        >>> sorted(transition_rows(rollout)["next"].keys())
        ['design', 'done', 'observation', 'reward', 'terminated', 'truncated']
    """
    missing = [key for key in ROW_KEYS if key not in transitions.keys(include_nested=True)]
    if missing:
        raise ValueError(
            f"transitions lack {missing}; step an environment that has `design` in its observation spec, such as a "
            "morph environment or WorldModelEnv, and pass what it returns"
        )
    rows = transitions.select(*ROW_KEYS)
    for key in ROW_KEYS:
        if rows[key].ndim != rows.batch_dims + 1:
            raise ValueError(
                f"{key} has shape {list(rows[key].shape)}, which must be batch size {list(rows.batch_size)} and one "
                "dimension for its entries; a single number has a last dimension of 1"
            )
    return rows


def time_is_last(rows: TensorDictBase) -> bool:
    """Whether rows are known to be ``[K, T]``, runs first, as a rollout returns them.

    The name of the dimension tells. Rows without names are told by their content, if there are as many steps as runs:
    in time, a row begins where the one before it ended.
    """
    if "time" in rows.names:
        return rows.names[0] != "time"
    steps, runs = rows.batch_size
    return steps == runs > 1 and _goes_on_along(rows, 1) and not _goes_on_along(rows, 0)


def _goes_on_along(rows: TensorDictBase, dim: int) -> bool:
    """Whether each row begins where the one before it in a dimension ended, except behind the end of an episode."""
    last = rows.shape[dim] - 1
    reached, begun = rows["next", "observation"].narrow(dim, 0, last), rows["observation"].narrow(dim, 1, last)
    return bool(((reached == begun) | rows["next", "done"].narrow(dim, 0, last)).all())


class TransitionBuffer(TensorDictReplayBuffer):
    """TorchRL's replay buffer with one schema, a generator of its own and checkpoints of the filled part only.

    Args:
        capacity: elements it can hold; the oldest are overwritten.
        num_runs: K, the batch size of an element.
        seed: of the generator that draws samples.
        device: where the rows live and samples are drawn; rows come from any device, samples are on this one.

    Example:
        >>> buffer = TransitionBuffer(100, num_runs=2, seed=0)
        >>> row = torch.zeros(5, 2, 1)
        >>> _ = buffer.extend(TensorDict({key: row for key in ROW_KEYS}, [5, 2]))
        >>> buffer.sample(256).shape
        torch.Size([256, 2])
    """

    def __init__(self, capacity: int, *, num_runs: int = 1, seed: int, device: torch.device | str = "cpu") -> None:
        if capacity < 1:
            raise ValueError(f"a buffer of {capacity} rows can hold nothing; pass a capacity of 1 or more")
        super().__init__(
            storage=LazyTensorStorage(capacity, device=device),
            sampler=RandomSampler(),
            # TensorDictReplayBuffer's own writer would store eight more bytes of row number in each row.
            writer=RoundRobinWriter(),
            generator=torch.Generator(device).manual_seed(seed),
        )
        self.capacity = capacity
        self.num_runs = num_runs

    def add(self, data: TensorDictBase) -> int:
        """Store one time step ``[K]``, as :meth:`extend` stores many.

        Returns:
            Where it went.

        Raises:
            ValueError: as :meth:`extend`.
        """
        return int(self.extend(data.unsqueeze(0)))

    def extend(self, tensordicts: TensorDictBase, *, update_priority: bool | None = None) -> torch.Tensor:
        """Store the numbers of transitions, without their graph; the argument is left as it is.

        Args:
            tensordicts: ``[T, K]``, as for :func:`transition_rows`.
            update_priority: part of TorchRL's signature; there are no priorities here.

        Returns:
            Where the rows went.

        Raises:
            ValueError: if the batch is not ``[T, K]``, is longer than the capacity, or lacks an entry; also if it is
                ``[K, T]`` with as many runs as steps, as far as that can be seen (see :func:`time_is_last`).
        """
        shape = tensordicts.batch_size
        if len(shape) != 2 or shape[1] != self.num_runs:
            raise ValueError(
                f"rows have batch size {list(shape)}, [T, {self.num_runs}] is needed: time first, then the runs "
                "(env.rollout returns [K, T]: transpose(0, 1) it)"
            )
        if shape[0] > self.capacity:
            raise ValueError(f"{shape[0]} rows do not fit into a buffer of {self.capacity}; enlarge its capacity")
        rows = transition_rows(tensordicts)
        if time_is_last(rows):
            raise ValueError(
                f"time is the last dimension of rows {list(shape)}, it must be the first, [T, {self.num_runs}]; "
                "transpose(0, 1) what env.rollout returns"
            )
        return super().extend(rows.detach().to(self.storage.device), update_priority=update_priority)

    def state_dict(self) -> dict[str, Any]:
        """Return the filled rows (views, not copies), the writer's place and the generator's state."""
        # From the storage, and not as samples are: transforms of the buffer have not changed what is kept.
        rows = self.storage[: len(self)].flatten_keys(".").to_dict() if len(self) else {}
        return {"rows": rows, "writer": self.writer.state_dict(), "generator": self._rng.get_state()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take the place of the buffer that :meth:`state_dict` was read from; this one may be larger.

        Raises:
            ValueError: if that one held more rows than fit here, or of another number of runs; nothing is changed then.
        """
        self.check_state(state_dict)
        self.empty()
        rows, writer = state_dict["rows"], dict(state_dict["writer"])
        if rows:
            count = len(next(iter(rows.values())))
            stored = TensorDict(rows, next(iter(rows.values())).shape[:2]).unflatten_keys(".")
            if count < self.capacity and writer["_cursor"] < count:
                # That one was full and about to overwrite its oldest row. There is room here: behind the newest.
                stored = torch.cat([stored[writer["_cursor"] :], stored[: writer["_cursor"]]])
                writer["_cursor"] = count
            self.writer.extend(stored.to(self.storage.device))
        writer["_cursor"] %= self.capacity
        self.writer.load_state_dict(writer)
        restore_generator(self._rng, state_dict["generator"])

    def check_state(self, state_dict: Mapping[str, Any]) -> None:
        """Refuse a state that does not fit; see :meth:`load_state_dict`."""
        for values in state_dict["rows"].values():
            if len(values) > self.capacity or values.shape[1] != self.num_runs:
                raise ValueError(
                    f"the state holds {len(values)} rows of {values.shape[1]} run(s), this buffer has room for "
                    f"{self.capacity} of {self.num_runs}; make it as large, and with as many runs, as the one saved"
                )


@dataclass(frozen=True, kw_only=True)
class Buffers:
    """The buffers that Algorithm 1 initialises first.

    Example:
        >>> from coim import HopperMorph
        >>> env = HopperMorph(num_runs=2, seed=0)
        >>> buffers = Buffers.for_env(env, pop_capacity=1000, ind_capacity=100, s0_capacity=10, art_capacity=50, seed=0)
        >>> _ = buffers.pop.extend(env.rollout(20, auto_reset=True).transpose(0, 1))
        >>> len(buffers.pop), len(buffers.art)
        (20, 0)
    """

    pop: TransitionBuffer
    """Replay_Pop: every transition of every design."""
    ind: TransitionBuffer
    """Replay_Ind: the transitions of the current design."""
    s0: TransitionBuffer
    """Replay_s0: the first transition of each episode."""
    art: TransitionBuffer
    """Replay_Art: imagined transitions, emptied and refilled after each episode."""

    @classmethod
    def for_env(
        cls,
        env: EnvBase,
        *,
        pop_capacity: int,
        ind_capacity: int,
        s0_capacity: int,
        art_capacity: int,
        seed: int,
        device: torch.device | str = "cpu",
    ) -> Buffers:
        """Make four empty buffers for the runs of an environment.

        Args:
            env: its batch size ``[K]`` is that of an element.
            pop_capacity: time steps that Replay_Pop can hold; a Half-Cheetah row takes 215 bytes per run.
            ind_capacity: time steps that Replay_Ind can hold.
            s0_capacity: episodes that Replay_s0 can hold.
            art_capacity: imagined rows that Replay_Art can hold, per run.
            seed: the buffers draw with generators of their own, derived from it.
            device: where all rows live.
        """
        capacities = {"pop": pop_capacity, "ind": ind_capacity, "s0": s0_capacity, "art": art_capacity}
        if len(env.batch_size) != 1:
            raise ValueError(f"the environment has batch size {list(env.batch_size)}, the buffers need [K], its runs")
        rng = torch.Generator("cpu").manual_seed(seed)
        seeds = torch.randint(2**62, (len(capacities),), generator=rng, device="cpu").tolist()
        return cls(
            **{
                name: TransitionBuffer(capacity, num_runs=env.batch_size[0], seed=own_seed, device=device)
                for (name, capacity), own_seed in zip(capacities.items(), seeds)
            }
        )

    def state_dict(self) -> dict[str, Any]:
        """Return the state of each buffer under its name, filled rows only."""
        return {field.name: getattr(self, field.name).state_dict() for field in fields(self)}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Fill the buffers as those that :meth:`state_dict` was read from.

        Raises:
            ValueError: if one of them does not fit; nothing is changed then.
        """
        self.check_state(state_dict)
        for field in fields(self):
            getattr(self, field.name).load_state_dict(state_dict[field.name])

    def check_state(self, state_dict: Mapping[str, Any]) -> None:
        """Refuse a state of which a buffer does not fit."""
        for field in fields(self):
            getattr(self, field.name).check_state(state_dict[field.name])
