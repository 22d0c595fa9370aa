"""Compiling a function of tensors as a whole, by `torch.compile`, for more than one thread, learner and process.

On a CPU Inductor's C++ wrapper is taken: it calls the products without Python between them, and lets other threads of
Python run meanwhile.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Hashable
from typing import Any, Generic, ParamSpec, TypeVar

import torch
from torch import Tensor
from torch.utils._pytree import tree_flatten

from coim.kept_code import fingerprint, keep, kept
from coim.products import Choice, chosen

P = ParamSpec("P")
R = TypeVar("R")

# Options of Inductor are process-wide while it compiles: one thread at a time.
_COMPILING = threading.Lock()
_MADE: dict[Hashable, Any] = {}


class Compiled(Generic[P, R]):
    """A function of tensors that is compiled on its first call, with the same results up to rounding.

    It may be called by several threads; whoever calls first compiles, the others wait. Later calls must have the shapes
    and dtypes of the first. Where `coim.products.use` has chosen other products since, it is compiled anew, once for
    each choice.

    Args:
        function: of tensors, without side effects and without branches on their values.
        device: of the tensors.

    Raises:
        RuntimeError: by a call, if it has other shapes; torch names the tensor.

    Note:
        Compiling takes seconds to a minute and needs a C++ compiler. Nothing falls back to the plain function: what
        cannot be compiled raises torch's own error. A function that has a name in its module is compiled once for all
        who compile it for tensors of the same sizes; one of coim, on a CPU, also for later processes, see
        `coim.kept_code`.

        What is called afterwards is the compiled code itself. `torch.compile` looks for it anew in every call, by a
        hook in the interpreter; in torch 2.13 that failed once ("found no compiled frames") in a run whose learners
        called from two threads. Why is not known, and no test has brought it back.

    Example:
        >>> import torch
        >>> quick = Compiled(lambda x: x.tanh().square(), torch.device("cpu"))
        >>> quick(torch.zeros(2))
        tensor([0., 0.])
    """

    def __init__(self, function: Callable[P, R], device: torch.device) -> None:
        self._function, self._device = function, device
        self._code: dict[Choice, Any] = {}

    def __getstate__(self) -> dict[str, Any]:
        """A copy compiles anew, or finds the code: that itself cannot be copied."""
        return self.__dict__ | {"_code": {}}

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        return self._code_for(args, kwargs)(*args, **kwargs)

    def checked(self, *args: P.args, **kwargs: P.kwargs) -> Callable[P, R]:
        """Check these inputs, and return code for others of the same shapes and types, which checks nothing any more.

        For calls that cannot differ: with networks of 3 x 64 a check is one part in thirty of an update.

        Raises:
            RuntimeError: if the inputs have other shapes than the first ones had.
        """
        code = self._code_for(args, kwargs)
        if not code.guard_check(*args, **kwargs):
            code(*args, **kwargs)  # raises, and names the tensor
        return code.fn

    def _code_for(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        products = chosen()
        if products not in self._code:
            with _COMPILING:
                if products not in self._code:
                    self._code[products] = _code_for(self._function, self._device, args, kwargs)
        return self._code[products]


def _code_for(function: Callable[..., Any], device: torch.device, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """The code for such inputs: of this process, of an earlier one, or made now."""
    name = f"{function.__module__}.{function.__qualname__}"
    if getattr(sys.modules.get(function.__module__), function.__qualname__, None) is not function:
        return _compile(function, device, args, kwargs)  # a local function: its name does not say what it does
    key = (name, fingerprint(function), device.type, chosen(), torch.get_num_threads(), described(args, kwargs))
    code = _MADE.get(key)
    if code is None and device.type == "cpu":  # a card's code was never tried in another process
        code = kept(function, key, args, kwargs)
    # Guards know of states of torch that the key does not, such as autocast.
    if code is None or not code.guard_check(*args, **kwargs):
        code = _compile(function, device, args, kwargs)
        if device.type == "cpu":
            keep(code, function, key)
    _MADE[key] = code
    return code


def _compile(function: Callable[..., Any], device: torch.device, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    options: dict[str, Any] = {"cpp_wrapper": device.type == "cpu"}
    with torch._dynamo.config.patch(enable_aot_compile=True):  # off by default in torch 2.11
        slow: Any = torch.compile(function, fullgraph=True, dynamic=False, options=options)
        return slow.aot_compile((args, kwargs))


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
