"""Moving a loss to another device or dtype together with the networks it was made of."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tensordict.nn import TensorDictParams
from torch import Tensor, nn


@contextmanager
def move(fn: Callable[[Tensor], Tensor], *networks: tuple[nn.Module, TensorDictParams]) -> Iterator[None]:
    """Around ``LossModule._apply``: the networks move first, each by rules of its own, and the loss takes after them.

    TorchRL's loss holds the networks' parameters, and moves these alone: buffers would stay behind in the networks.

    Args:
        fn: what ``_apply`` applies.
        networks: each with what the loss holds of it.
    """
    for network, _ in networks:
        network._apply(fn)
    yield
    for network, params in networks:
        for name, buffer in network.named_buffers():
            params.get(tuple(name.split("."))).data = buffer
