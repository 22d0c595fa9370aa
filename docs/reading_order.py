"""The order in which the site lists the tutorials; sphinx-gallery would sort them by their names."""

from __future__ import annotations

from pathlib import Path

TUTORIALS = (
    "first_coadaptation",
    "bodies",
    "loss",
    "ensemble",
    "choosing",
    "study",
    "own_robot",
    "gpu_and_cluster",
    "watching",
)


class ReadingOrder:
    """Key by which sphinx-gallery sorts the scripts of a folder.

    Args:
        folder: the scripts' folder, which does not matter here.
    """

    def __init__(self, folder: str) -> None:
        self.folder = folder

    def __call__(self, name: str) -> int:
        """Place of a script among the others."""
        return TUTORIALS.index(Path(name).stem)
