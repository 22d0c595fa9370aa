"""MuJoCo for the browser, read from its npm package, to be put into a page.

The package is not shipped with coim: it has 10 MB of WebAssembly. It is one download, and 2.5 MB when compressed.

References:
    The package @mujoco/mujoco of npm, by Google DeepMind, Apache License 2.0.
"""

from __future__ import annotations

import base64
import gzip
import json
import tarfile
from dataclasses import dataclass
from pathlib import Path

NAME = "@mujoco/mujoco"
FETCH = "npm pack @mujoco/mujoco"


@dataclass(frozen=True, kw_only=True)
class Simulator:
    """What a page needs to simulate.

    Attributes:
        version: of the package.
        licence: its SPDX name.
        module: the JavaScript module, gzip in base64.
        binary: the WebAssembly, gzip in base64.
    """

    version: str
    licence: str
    module: str
    binary: str


def read_simulator(path: Path) -> Simulator:
    """Read the package from its archive, or from a folder into which it was unpacked.

    Args:
        path: ``mujoco-mujoco-VERSION.tgz``, ``node_modules/@mujoco/mujoco``, or a folder that holds one of both.

    Raises:
        ValueError: if it is not there or no such package; the message says where it can be had.
    """
    try:
        files = _from_archive(path) if path.is_file() else _from_folder(path)
        about = json.loads(files["package.json"])
        if about["name"] != NAME:
            raise ValueError(f"it holds the package {about['name']}")
        version, licence = str(about["version"]), str(about["license"])
    except (OSError, tarfile.TarError, KeyError, ValueError) as error:
        raise ValueError(f"{path} is no package {NAME} ({error}); fetch it once: {FETCH}") from None
    module, binary = (
        # Without a time: the same package gives the same page.
        base64.b64encode(gzip.compress(files[name], 9, mtime=0)).decode()
        for name in ("mujoco.js", "mujoco.wasm")
    )
    return Simulator(version=version, licence=licence, module=module, binary=binary)


FILES = ("package.json", "mujoco.js", "mujoco.wasm")


def _from_archive(path: Path) -> dict[str, bytes]:
    with tarfile.open(path) as archive:
        members = {name: archive.extractfile(f"package/{name}") for name in FILES}
        return {name: member.read() for name, member in members.items() if member is not None}


def _from_folder(path: Path) -> dict[str, bytes]:
    for folder in (path, path / "package", path / "node_modules" / NAME, path / NAME):
        if (folder / FILES[0]).is_file():
            return {name: (folder / name).read_bytes() for name in FILES}
    raise OSError(f"no {FILES[0]} in it")
