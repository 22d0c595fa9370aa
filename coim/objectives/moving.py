"""What a loss does with its networks: move them with it, and lend them other weights for one pass."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tensordict import TensorDictBase
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


@contextmanager
def lent(weights: TensorDictBase, network: nn.Module) -> Iterator[None]:
    """Let a network compute with these weights, and give it its own back, whatever happens meanwhile.

    The context of ``TensorDict.to_module`` gives them back only if nothing was raised: after an error the network
    would be left with the weights of its targets, or with none that its `parameters` show.

    Args:
        weights: of the network; its names and shapes.
        network: keeps them until the end of the context.
    """
    own = weights.to_module(network, preserve_module_state=False)
    try:
        yield
    finally:
        own.to_module(network, preserve_module_state=False)
