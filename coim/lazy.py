"""Names of a package whose modules are imported when they are first asked for, and calls that wait for an import.

Losses and networks can be lifted out where mujoco or pyswarms is not installed: only what needs them imports them.

References:
    PEP 562: Module ``__getattr__`` and ``__dir__``, https://peps.python.org/pep-0562.
    PEP 302: New import hooks, https://peps.python.org/pep-0302.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import Any


def lazy_names(
    package: str, homes: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Make the ``__getattr__`` and the ``__dir__`` of a package.

    Type checkers read the package's imports under ``TYPE_CHECKING`` instead.

    Args:
        package: ``__name__`` of the package.
        homes: the public names by the module of the package that defines them. The package's modules are found by their
            names too, as if it had imported them.

    Returns:
        Functions to be assigned to ``__getattr__`` and ``__dir__``. The first raises AttributeError for an unknown
        name, and whatever the module raises that it imports.
    """
    home_of = {name: module for module, names in homes.items() for name in names}

    def getattribute(name: str) -> Any:
        if name in home_of:
            value = getattr(import_module(f"{package}.{home_of[name]}"), name)
        elif not name.startswith("_") and find_spec(f"{package}.{name}") is not None:
            value = import_module(f"{package}.{name}")
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        setattr(sys.modules[package], name, value)  # Python finds it by itself from now on
        return value

    def directory() -> list[str]:
        return sorted({*vars(sys.modules[package]), *home_of})

    return getattribute, directory


def when_imported(module: str, call: Callable[[], None]) -> None:
    """Call once a module has been imported: at once if it is already, and never if it never is.

    Args:
        module: name of a module without a dot, such as ``"gymnasium"``.
        call: what to call then. What it raises, the import raises.
    """
    if sys.modules.get(module) is not None:
        call()
    elif module not in sys.modules:  # None there forbids its import
        sys.meta_path.insert(0, _Waiting(module, call))


class _Waiting(MetaPathFinder):
    """Finds one module as all other finders do, and calls a function behind its import; then it is gone.

    It stays while others only look whether the module is there, as TorchRL does.
    """

    def __init__(self, module: str, call: Callable[[], None]) -> None:
        self._module, self._call, self._looking = module, call, False

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The module's spec with a loader that calls the function; None for every other module."""
        if fullname != self._module or self._looking:
            return None
        self._looking = True
        try:
            spec = find_spec(fullname)
        finally:
            self._looking = False
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def exec_module(module: ModuleType) -> None:
                if self in sys.meta_path:
                    sys.meta_path.remove(self)
                execute(module)
                self._call()

            spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec
