"""Compiling a function of tensors as a whole, by `torch.compile`, for more than one thread.

On a CPU Inductor's C++ wrapper is taken: it calls the products without Python between them, and lets other threads of
Python run meanwhile.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import torch

from coim.products import Choice, chosen

P = ParamSpec("P")
R = TypeVar("R")

# Options of Inductor are process-wide while it compiles: one thread at a time.
_COMPILING = threading.Lock()


def compiled(function: Callable[P, R], device: torch.device) -> Callable[P, R]:
    """Compile a function on its first call.

    Args:
        function: of tensors, without side effects and without branches on their values.
        device: of the tensors.

    Returns:
        A function with the same results up to rounding. It may be called by several threads; whoever calls first
        compiles, the others wait. Later calls must have the shapes and dtypes of the first. Where `coim.products.use`
        has chosen other products since, it is compiled anew, once for each choice.

    Raises:
        RuntimeError: by the returned function, if a call has other shapes; torch names the tensor.

    Note:
        Compiling takes seconds to a minute and needs a C++ compiler. Nothing falls back to the plain function: what
        cannot be compiled raises torch's own error.

        What is called afterwards is the compiled code itself. `torch.compile` looks for it anew in every call, by a
        hook in the interpreter; in torch 2.13 that failed once ("found no compiled frames") in a run whose learners
        called from two threads. Why is not known, and no test has brought it back.

    Example:
        >>> import torch
        >>> quick = compiled(lambda x: x.tanh().square(), torch.device("cpu"))
        >>> quick(torch.zeros(2))
        tensor([0., 0.])
    """
    quick: dict[Choice, Callable[P, R]] = {}

    def compiled_for(*inputs: object) -> Callable[P, R]:
        options: dict[str, Any] = {"cpp_wrapper": device.type == "cpu"}
        with torch._dynamo.config.patch(enable_aot_compile=True):  # off by default in torch 2.11
            slow: Any = torch.compile(function, fullgraph=True, dynamic=False, options=options)
            return slow.aot_compile(inputs)

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        products = chosen()
        if products not in quick:
            with _COMPILING:
                if products not in quick:
                    quick[products] = compiled_for(args, kwargs)
        return quick[products](*args, **kwargs)

    return call
