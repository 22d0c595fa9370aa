"""Names of a package whose modules are imported when they are first asked for.

Losses and networks can be lifted out where mujoco or pyswarms is not installed: only what needs them imports them.

References:
    PEP 562: Module ``__getattr__`` and ``__dir__``, https://peps.python.org/pep-0562.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
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
