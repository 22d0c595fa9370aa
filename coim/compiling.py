"""Compiling a function of tensors as a whole, by `torch.compile`, for more than one thread and learner: on a GPU.

On a CPU the gradients are native code, see `coim.objectives.native_gradients`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable
from typing import Any, Generic, ParamSpec, TypeVar

import torch
from torch import Tensor
from torch.utils._pytree import tree_flatten

P = ParamSpec("P")
R = TypeVar("R")

# The option that `_code_for` sets is process-wide: one thread at a time.
_COMPILING = threading.Lock()
_MADE: dict[Hashable, Any] = {}


class Compiled(Generic[P, R]):
    """A function of tensors that is compiled on its first call, with the same results up to rounding.

    It may be called by several threads; whoever calls first compiles, the others wait. Later calls must have the shapes
    and dtypes of the first.

    Args:
        function: of tensors, without side effects and without branches on their values.

    Raises:
        RuntimeError: by a call, if it has other shapes; torch names the tensor.

    Note:
        Compiling takes seconds to a minute and needs a compiler. Nothing falls back to the plain function: what cannot
        be compiled raises torch's own error. A function is compiled once for all who compile it for tensors of the same
        sizes.

        What is called afterwards is the compiled code itself. `torch.compile` looks for it anew in every call, by a
        hook in the interpreter; in torch 2.13 that failed once ("found no compiled frames") in a run whose learners
        called from two threads. Why is not known, and no test has brought it back.

    Example:
        >>> import torch
        >>> quick = Compiled(lambda x: x.tanh().square())
        >>> quick(torch.zeros(2))
        tensor([0., 0.])
    """

    def __init__(self, function: Callable[P, R]) -> None:
        self._function = function
        self._code: Any = None

    def __getstate__(self) -> dict[str, Any]:
        """A copy compiles anew, or finds the code: that itself cannot be copied."""
        return self.__dict__ | {"_code": None}

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        return self._code_for(args, kwargs)(*args, **kwargs)

    def checked(self, *args: P.args, **kwargs: P.kwargs) -> Callable[P, R]:
        """Check these inputs, and return code for others of the same shapes and types, which checks nothing any more.

        Raises:
            RuntimeError: if the inputs have other shapes than the first ones had.
        """
        code = self._code_for(args, kwargs)
        if not code.guard_check(*args, **kwargs):
            code(*args, **kwargs)  # raises, and names the tensor
        return code.fn

    def _code_for(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        if self._code is None:
            with _COMPILING:
                if self._code is None:
                    self._code = _code_for(self._function, args, kwargs)
        return self._code


def _code_for(function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """The code for such inputs, of this process or made now."""
    key = (function, described(args, kwargs))
    code = _MADE.get(key)
    # Guards know of states of torch that the key does not, such as autocast.
    if code is None or not code.guard_check(*args, **kwargs):
        with torch._dynamo.config.patch(enable_aot_compile=True):  # off by default in torch 2.11
            slow: Any = torch.compile(function, fullgraph=True, dynamic=False)
            code = _MADE[key] = slow.aot_compile((args, kwargs))
    return code


def described(args: tuple[Any, ...], kwargs: dict[str, Any]) -> Hashable:
    """What code is compiled for: sizes, types and devices of tensors, which of them are the same, all else as it is.

    Example:
        >>> x, y = torch.zeros(2), torch.ones(2)
        >>> described((x, y), {}) == described((y, x), {}), described((x, x), {}) == described((x, y), {})
        (True, False)
    """
    leaves, structure = tree_flatten((args, kwargs))
    places = [id(leaf) for leaf in leaves]
    tensors = tuple(
        (tuple(x.shape), x.stride(), str(x.dtype), str(x.device), x.requires_grad, places.index(id(x)))
        if isinstance(x, Tensor)
        else repr(x)
        for x in leaves
    )
    return tensors, str(structure), torch.is_grad_enabled()
