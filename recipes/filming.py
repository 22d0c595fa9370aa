"""Films of bodies under their policies: an episode is played again, photographed and labelled, frame by frame.

Shapes: T steps, K runs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from tensordict import TensorDict

from coim import SavedRun, TriedDesign, load_run
from coim.envs.camera import Camera
from recipes.commands import in_names
from recipes.reporting.records import number
from recipes.writing import written_aside

FRAMES_PER_SECOND = 30  # at most; an environment that takes fewer steps in a second shows each of them
TOP = 5
TEXT_SHARE, LEAST_TEXT = 24, 12  # height of a picture over that of its letters; pixels
MOST_TEXT = 0.4  # of the height of a picture may be covered
GAP = 4  # pixels between two pictures


@dataclass(frozen=True, eq=False)
class Take:
    """One episode, ready to be photographed.

    Attributes:
        tried: the design.
        entries: of the design, by their names.
        camera: in front of its body.
        poses: joint positions before each step and after the last, ``[T + 1, nq]``.
        speed: along x in m/s, ``[T + 1]``.
        returned: rewards so far, ``[T + 1]``.
        step_seconds: what a step takes in the simulated world.
    """

    tried: TriedDesign
    entries: Sequence[str]
    camera: Camera
    poses: np.ndarray
    speed: np.ndarray
    returned: np.ndarray
    step_seconds: float

    def frames(self, stride: int) -> Iterator[np.ndarray]:
        """Every so many steps a labelled picture, ``[height, width, 3]`` uint8."""
        with self.camera:
            for t in range(0, len(self.poses), stride):
                time, speed = t * self.step_seconds, round(self.speed[t], 2) + 0.0  # no "-0.00"
                lines = (
                    f"design {self.tried.number}, {self.tried.kind}: best return {number(self.tried.best_return)}",
                    f"{time:.1f} s   {speed:+.2f} m/s   return {number(self.returned[t])}",
                )
                yield labelled(self.camera.photograph(self.poses[t]), lines, self.entries)


def film(folder: Path, *, design: str, run: int | None, steps: int | None, width: int, height: int) -> Iterator[Path]:
    """Write the films that are asked for, one after the other.

    Args:
        folder: of a run.
        design: ``best``, ``top5``, ``all``, or a number from 1.
        run: one of K; None takes the one with the best return of what is asked for.
        steps: to show; None shows the run's whole episode.
        width: pixels of one picture.
        height: likewise.

    Yields:
        Each film, when it is written.

    Raises:
        ValueError: if there is no such run or design, or a size cannot be filmed.
        RuntimeError: if there is nothing to draw with; the sentence says what to install and set.
    """
    for name, value in (("width", width), ("height", height)):
        if value < 32 or value % 2:
            raise ValueError(f"{name} is {value}, it must be even (H.264 halves the colours) and at least 32")
    if steps is not None and steps < 1:
        raise ValueError(f"steps is {steps}, it must be at least 1; leave it out for the whole episode")
    torch.set_num_threads(1)  # as in training: another number could round otherwise
    loaded = load_run(folder)
    if run is not None and not 0 <= run < loaded.bodies.numel():
        raise ValueError(f"run {run} is not in {folder}, which has runs 0 .. {loaded.bodies.numel() - 1}")
    chosen = choose(loaded, design, run)
    if steps is not None:
        loaded.bodies.episode_steps = steps
    several = loaded.bodies.numel() > 1
    together = [chosen] if design == "top5" else [[tried] for tried in chosen]
    for designs in together:
        name = "top5" if design == "top5" else f"design-{designs[0].number}"
        prefix = f"run-{designs[0].run}-" if several else ""
        path = folder / "videos" / f"{prefix}{name}.mp4"
        write_film(path, [take(loaded, tried, width, height) for tried in designs])
        yield path


def choose(loaded: SavedRun, design: str, run: int | None) -> list[TriedDesign]:
    """The designs that are asked for, all of one run; the best come first in ``top5``."""
    ranked = sorted(
        (tried for tried in loaded.designs if math.isfinite(tried.best_return) and run in (None, tried.run)),
        key=lambda tried: -tried.best_return,
    )
    whose = "" if run is None else f" of run {run}"
    if not ranked:
        raise ValueError(
            f"no design{whose} in {loaded.folder} has a return yet; wait for the next row of its designs.csv"
        )
    if design not in ("best", "top5", "all"):
        done = sorted({tried.number for tried in ranked})
        ranked = [tried for tried in ranked if str(tried.number) == design]
        if not ranked:
            raise ValueError(
                f"--design is {design!r}: choose best, top5, all or one of the designs that are done{whose}, {done}"
            )
    own = [tried for tried in ranked if tried.run == ranked[0].run]
    if design == "all":
        return sorted(own, key=lambda tried: tried.number)
    return own[: TOP if design == "top5" else 1]


def take(loaded: SavedRun, tried: TriedDesign, width: int, height: int) -> Take:
    """Play the best evaluation of a design again, twice: for its actions, and for the poses that they led to."""
    bodies, row = loaded.bodies, tried.run
    actions = loaded.best_episode(tried.number)["action"]
    bodies.reset(TensorDict({"design": loaded.rewind(tried.number)}, bodies.batch_size))
    simulations = bodies.simulations
    poses, speed, rewards = [simulations.qpos[row].copy()], [float(simulations.qvel[row, 0])], [0.0]
    for action in actions:
        _, reward, broken = bodies.advance(action)
        poses.append(simulations.qpos[row].copy())
        speed.append(float(simulations.qvel[row, 0]))
        rewards.append(float(reward[row]))
        if broken.any():
            bodies.reset(TensorDict({"_reset": broken}, bodies.batch_size))
    return Take(
        tried=tried,
        entries=in_names(tried.design.tolist(), type(bodies)),
        camera=bodies.camera(row, width=width, height=height),
        poses=np.stack(poses),
        speed=np.array(speed),
        returned=np.cumsum(rewards),
        step_seconds=bodies.step_seconds,
    )


def write_film(path: Path, takes: Sequence[Take]) -> None:
    """Film one episode, or several beside each other, at the speed at which they happened."""
    step_seconds = takes[0].step_seconds
    stride = max(1, math.ceil(1 / (FRAMES_PER_SECOND * step_seconds)))
    path.parent.mkdir(parents=True, exist_ok=True)
    rate = 1 / (stride * step_seconds)
    with (
        written_aside(path) as aside,
        imageio.get_writer(aside, fps=rate, codec="libx264", quality=8, macro_block_size=2) as writer,
    ):
        for pictures in zip(*(shot.frames(stride) for shot in takes), strict=True):
            writer.append_data(side_by_side(pictures))


def side_by_side(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Pictures of one size in lines of equal length, from left to right and from above; white where there is none."""
    if len(pictures) == 1:
        return pictures[0]
    columns = math.ceil(math.sqrt(len(pictures)))
    framed = [np.pad(picture, ((0, GAP), (0, GAP), (0, 0)), constant_values=255) for picture in pictures]
    lines = [framed[i : i + columns] for i in range(0, len(framed), columns)]
    white = np.full_like(framed[0], 255)
    return np.concatenate([np.concatenate([*line, *[white] * (columns - len(line))], 1) for line in lines])


def labelled(picture: np.ndarray, lines: Sequence[str], entries: Sequence[str] = ()) -> np.ndarray:
    """A picture with lines of text at its top, dark on a light band.

    Args:
        picture: ``[height, width, 3]`` uint8.
        lines: of text.
        entries: words that go below them, as many in a line as it can hold; none where all of them would take too much
            of the picture.
    """
    size = max(LEAST_TEXT, picture.shape[0] // TEXT_SHARE)
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image, "RGBA")
    font = ImageFont.load_default(size)

    def bottom(lines: Sequence[str]) -> int:
        return (len(lines) * 13 + 6) * size // 10

    below: list[str] = []
    for entry in entries:
        longer = f"{below[-1]}, {entry}" if below else entry
        if below and font.getlength(longer) <= image.width - size:
            below[-1] = longer
        else:
            below.append(entry)
    if bottom([*lines, *below]) <= MOST_TEXT * image.height:
        lines = [*lines, *below]
    draw.rectangle((0, 0, image.width, bottom(lines)), fill=(255, 255, 255, 190))
    for i, line in enumerate(lines):
        draw.text((size // 2, (i * 13 + 3) * size // 10), line, fill=(0, 0, 0), font=font)
    return np.asarray(image)
