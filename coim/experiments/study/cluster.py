"""Ray, started on this machine for one study, or a cluster that is connected to.

References:
    Moritz et al.: Ray, a distributed framework for emerging AI applications, OSDI 2018; https://docs.ray.io.
"""

from __future__ import annotations

import os
import secrets
import shutil
import socket
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, TextIO

import ray

from coim.experiments.run.interrupt import ANY_NAME, sentence_of

ANSWER = 5.0  # s to wait for a cluster
OBJECT_STORE = 80 * 2**20  # bytes; what a cell makes is on disk, nothing goes through Ray
SOCKET = 103  # bytes of a socket's path on macOS; on Linux 107
SOCKETS = 77  # bytes that our folder, Ray's session and its sockets' names add to the folder that they are in
LONGEST = SOCKET - SOCKETS
SHORT = ("/tmp", "/var/tmp", "/dev/shm")


@contextmanager
def ray_running(terminal: TextIO, *, address: str | None = None, workers: int = 1, cpus: int = 1) -> Iterator[None]:
    """Connect to a cluster, or be one for as long as this lasts.

    Args:
        terminal: where its user reads.
        address: of a cluster; None starts Ray on this machine.
        workers: cells at once on this machine.
        cpus: cores of each.

    Raises:
        ValueError: if nobody answers at the address.
        OSError: if there is no folder for Ray's sockets.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    common: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address is not None:
        print(f"connecting to Ray at {address}", file=terminal, flush=True)
        refuse_silence(address)
        ray.init(address=address, **common)
        try:
            yield
        finally:
            ray.shutdown()
        return
    print("starting Ray on this machine, about 10 s", file=terminal, flush=True)
    temporary = tempfile.mkdtemp(prefix="ray-", dir=short_folder())
    try:
        with token_without_file():
            try:
                ray.init(
                    address="local",  # whatever RAY_ADDRESS says
                    num_cpus=workers * cpus,
                    include_dashboard=False,
                    object_store_memory=OBJECT_STORE,
                    _temp_dir=temporary,
                    **common,
                )
            except Exception as error:  # Ray raises it bare where the machine is too busy to answer in time
                why = sentence_of(error).splitlines()[0]
                raise OSError(
                    f"Ray did not start on this machine ({why}); give the same command again when it is less busy"
                ) from error
            yield
    finally:
        ray.shutdown()
        shutil.rmtree(temporary, ignore_errors=True)


def short_folder() -> str:
    """A folder for temporary files in which the paths of Ray's sockets are not too long.

    It is that of TMPDIR if it is short; those of macOS and of many schedulers are not.

    Raises:
        OSError: if there is none.
    """
    usual = tempfile.gettempdir()
    for folder in (usual, *SHORT):
        if len(os.fsencode(folder)) <= LONGEST and os.access(folder, os.W_OK | os.X_OK):
            return folder
    raise OSError(
        f"the sockets of Ray need a folder whose path has at most {LONGEST} bytes; TMPDIR is {usual}, and none of "
        f"{', '.join(SHORT)} can be written to: set TMPDIR to a shorter one"
    )


@contextmanager
def token_without_file() -> Iterator[None]:
    """Let Ray's processes know each other by a token in their environment.

    Ray itself would write one to HOME, where not everybody may write. One that its user has set stays.
    """
    own = not {"RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"} & os.environ.keys()
    if own:
        os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
    try:
        yield
    finally:
        if own:
            del os.environ["RAY_AUTH_TOKEN"]


@contextmanager
def without_words_of_ray(folder: Path) -> Iterator[TextIO]:
    """Let Ray, which reports each death of a process at length, write to ``logs/ray.log`` in a study's folder.

    Yields:
        What was the standard output.
    """
    terminal, words = sys.stdout, folder / "logs" / "ray.log"
    words.parent.mkdir(parents=True, exist_ok=True)
    with words.open("a", buffering=1, errors=ANY_NAME) as file, redirect_stdout(file), redirect_stderr(file):
        yield terminal


def refuse_silence(address: str) -> None:
    """Say that nobody answers at HOST:PORT; Ray itself would try for minutes.

    Raises:
        ValueError: if nobody does.
    """
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal():
        return  # auto, or a form that Ray reads itself
    try:
        socket.create_connection((host, int(port)), timeout=ANSWER).close()
    except (OSError, OverflowError) as error:
        raise ValueError(
            f"no Ray cluster answers at {address} ({error}); start one with `ray start --head`, or leave --ray-address "
            "away"
        ) from None
