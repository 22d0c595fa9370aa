"""The origin of a run, as ``config.json`` has it: settings, versions, machine, revision, time."""

from __future__ import annotations

import datetime
import functools
import platform
import secrets
import subprocess
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from coim.experiments.run.settings import Settings, plain
from coim.products import chosen

PACKAGES = ("coim", "torch", "torchrl", "tensordict", "mujoco", "pyswarms", "numpy")
IF_THERE = ("botorch", "gpytorch", "scipy")  # choose bodies by returns


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that the numbers depend on."""
    found = {"python": platform.python_version()} | {name: _version(name) for name in PACKAGES}
    for name in IF_THERE:
        with suppress(PackageNotFoundError):
            found[name] = _version(name)
    return found


_version = functools.cache(version)  # it parses a long text each time


def describe(environment: str, settings: Settings) -> dict[str, Any]:
    """Everything that is needed to repeat the run."""
    return {
        "environment": environment,
        "settings": plain(settings),
        "products": chosen()._asdict(),
        "versions": versions(),
        "machine": {"processor": platform.processor() or platform.machine(), "system": platform.platform()},
        "revision": git_revision(),
        "started": now(),
        "wandb_id": secrets.token_hex(4),  # one W&B run holds the whole curve, however often it is resumed
    }


def now() -> str:
    """The time in UTC, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def git_revision() -> str | None:
    """Commit of the checkout of this file, with ``-dirty`` if files in it were changed.

    Returns:
        None outside of a checkout, and where coim is installed inside of another project's checkout.
    """
    here = Path(__file__)
    describe = ["describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        said = [
            subprocess.run(["git", "-C", here.parent, *words], capture_output=True, text=True, check=True).stdout
            for words in (["ls-files", "--error-unmatch", here.name], describe)
        ]
    except (OSError, subprocess.CalledProcessError):
        return None
    return said[-1].strip()
