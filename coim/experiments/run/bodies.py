"""The body of a run, also one that is none of ours, by the name of its class on a command line."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path

from coim.envs import BODIES, MorphEnv
from coim.run_folder import read_config
from coim.saved_run import SavedRun, load_run


def imported_body(name: str | None) -> type[MorphEnv] | None:
    """The class that a command line names.

    Args:
        name: ``module:Class``; the module is looked for as Python does, the present folder included. None is none.

    Raises:
        ValueError: if there is no such module or class, or it is no `MorphEnv`.

    Example:
        >>> imported_body("coim.envs.hopper:HopperMorph").__name__
        'HopperMorph'
        >>> imported_body("coim.envs.hopper")
        Traceback (most recent call last):
        ValueError: --body is 'coim.envs.hopper', it must be module:Class, such as coim.envs.hopper:HopperMorph
    """
    if name is None:
        return None
    module, _, called = name.partition(":")
    if not module or not called:
        raise ValueError(f"--body is {name!r}, it must be module:Class, such as coim.envs.hopper:HopperMorph")
    if not {"", here := str(Path.cwd())} & {*sys.path}:
        sys.path.insert(0, here)  # Python looks there for a script or -m, and not for an installed command
    try:
        body = getattr(import_module(module), called)
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"--body {name} cannot be found ({error}); start from the folder in which {module} lies"
        ) from None
    if not (isinstance(body, type) and issubclass(body, MorphEnv)):
        raise ValueError(f"--body {name} is no body: name a class that is derived from coim.MorphEnv")
    return body


def opened(folder: Path, body: str | None, *, run: int | None = None) -> SavedRun:
    """Open a run folder.

    Args:
        folder: of the run.
        body: class of the body as ``module:Class``; None takes the one that the run's environment names.
        run: one of K runs; None takes all.

    Raises:
        ValueError: if its body is unknown; the message names the option that says which class it is.
    """
    environment = read_config(folder)["environment"]
    if body is None and environment not in BODIES:
        raise ValueError(
            f"{folder} holds a run of {environment!r}, which is none of {', '.join(BODIES)}; name the class of its "
            "body with --body module:Class"
        )
    return load_run(folder, run=run, body=imported_body(body))
