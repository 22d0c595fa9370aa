"""Move a loss and its networks to another device or dtype together."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tensordict.nn import TensorDictParams
from torch import Tensor, nn


@contextmanager
def move(fn: Callable[[Tensor], Tensor], *networks: tuple[nn.Module, TensorDictParams]) -> Iterator[None]:
    """Wrap ``LossModule._apply``: move the networks before it, each by its own rules, and share their buffers after it.

    TorchRL's loss moves only the parameters that it holds. The networks' buffers would stay on the old device.

    Args:
        fn: the function that ``_apply`` applies.
        networks: pairs of a network and the parameters of it that the loss holds.
    """
    for network, _ in networks:
        network._apply(fn)
    yield
    for network, params in networks:
        for name, buffer in network.named_buffers():
            params.get(tuple(name.split("."))).data = buffer
