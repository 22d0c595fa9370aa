"""Write the atlas of a run: ``coim atlas runs/A``, or ``runs/A runs/B`` for several seeds.

One page that opens from a file, without a network: every body over time, its return and what was expected of it, which
length would gain most, how alike the best bodies are, and a robot that walks in the page. With ``--mujoco`` the robot
is simulated in the browser, on any body that its sliders set; without it, recorded walks of the bodies tried are
played. The simulator is an npm package of Google DeepMind (Apache License 2.0), which is fetched once:
``npm pack @mujoco/mujoco``.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

import tyro

from coim.experiments.run.interrupt import on_command_line


@dataclasses.dataclass(frozen=True, kw_only=True)
class Atlas:
    """Write atlas.html about a run, or about several seeds."""

    folders: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders of one environment."""
    mujoco: Path | None = None
    """MuJoCo for the browser: mujoco-mujoco-VERSION.tgz, as npm pack @mujoco/mujoco fetches it, or a folder with it.
    The page grows by 4 MB. Without it, recorded walks are played."""
    out: Path | None = None
    """The page, or a folder for it; by default atlas.html in the run's folder, of several runs/atlas-DATE.html."""
    body: str | None = None
    """Class of the body as module:Class, if it is not one of ours."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    asked = tyro.cli(Atlas, prog="coim atlas", args=arguments)
    with on_command_line(own_process=arguments is None):
        print(f"reading {' '.join(map(str, asked.folders))}", file=sys.stderr, flush=True)  # walks take seconds
        from coim.experiments.atlas.write_atlas import write_atlas
        from coim.experiments.run.bodies import imported_body

        body = imported_body(asked.body)
        path, why = write_atlas(asked.folders, out=asked.out, body=body, mujoco=asked.mujoco)
        if why:
            print(f"the page plays recorded walks and simulates none: {why}", file=sys.stderr, flush=True)
        print(path)
