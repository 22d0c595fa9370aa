"""Compiling a function of tensors as a whole, by `torch.compile`, for more than one thread.

On a CPU Inductor's C++ wrapper is taken: it calls the products without Python between them, and lets other threads of
Python run meanwhile.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")

# Options of Inductor are process-wide while it compiles: one thread at a time.
_COMPILING = threading.Lock()


def compiled(function: Callable[P, R], device: torch.device) -> Callable[P, R]:
    """Compile a function on its first call; later calls of the same shapes and dtypes take what was compiled then.

    Args:
        function: of tensors, without side effects and without branches on their values.
        device: of the tensors.

    Returns:
        A function with the same results up to rounding. It may be called by several threads; whoever calls first
        compiles, the others wait.

    Note:
        Compiling takes seconds to a minute and needs a C++ compiler. Nothing falls back to the plain function: what
        cannot be compiled raises torch's own error.

    Example:
        >>> import torch
        >>> quick = compiled(lambda x: x.tanh().square(), torch.device("cpu"))
        >>> quick(torch.zeros(2))
        tensor([0., 0.])
    """
    quick = torch.compile(function, fullgraph=True, dynamic=False, options={"cpp_wrapper": device.type == "cpu"})
    ready = threading.Event()

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if ready.is_set():
            return quick(*args, **kwargs)
        with _COMPILING:
            result = quick(*args, **kwargs)
            ready.set()
        return result

    return call
