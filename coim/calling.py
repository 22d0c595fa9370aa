"""Whether calling a module does what its class is known to do, so that a faster way to the same may be taken."""

from __future__ import annotations

from collections.abc import Collection

from torch import nn


def called_as(module: nn.Module, *kinds: type[nn.Module]) -> bool:
    """Whether calling a module is calling one of these kinds: it has neither a forward of its own nor hooks.

    Its parts are not looked at; see :func:`altered_part`.
    """
    hooks = module._forward_hooks or module._forward_pre_hooks or module._backward_hooks or module._backward_pre_hooks
    return not hooks and _forward_of(module, kinds)


def altered_part(network: nn.Module, kinds: Collection[type[nn.Module]]) -> str | None:
    """Name the first part of a network that may compute something else than parts of these kinds, and say why.

    Returns:
        Such as "Policy.module.0.module.mlp.activation, a ELU, has a forward of its own"; None if there is no such part.

    Example:
        >>> altered_part(nn.Sequential(nn.Linear(1, 1), nn.ELU()), (nn.Sequential, nn.Linear, nn.ReLU))
        'Sequential.1, a ELU, has a forward of its own'
    """
    for name, part in network.named_modules():
        if not called_as(part, *kinds):
            where = f"{type(network).__name__}.{name}" if name else type(network).__name__
            reason = "hooks" if _forward_of(part, kinds) else "a forward of its own"
            return f"{where}, a {type(part).__name__}, has {reason}"
    return None


def _forward_of(module: nn.Module, kinds: Collection[type[nn.Module]]) -> bool:
    return type(module).forward in [kind.forward for kind in kinds] and "forward" not in vars(module)
