"""An episode played again, photographed and labelled frame by frame, and written as a film.

Shapes: T steps, K runs, D design.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from coim.envs import MorphEnv
from coim.envs.camera import Camera
from coim.episode import run_episode
from coim.experiments.run.atomic_write import naming_out, written_aside
from coim.experiments.run.last_words import in_names
from coim.experiments.run.progress import counted
from coim.experiments.run.records import number

# At most, for each kind of file; an environment that takes fewer steps in a second shows each of them.
FRAMES_PER_SECOND = {".mp4": 30, ".webp": 15}
WEBP_QUALITY = 40  # of 100: a minute of films on a page should not outweigh it
TEXT_SHARE, LEAST_TEXT = 24, 12  # height of a picture over that of its letters; pixels
MOST_TEXT = 0.4  # of the height of a picture may be covered
GAP = 4  # pixels between two pictures


@dataclass(frozen=True, eq=False)
class Take:
    """One episode, ready to be photographed.

    Attributes:
        title: first line of each picture.
        design: the body, ``[D]``.
        entries: entries of the design, with their names.
        camera: camera in front of the body.
        poses: joint positions before each step and after the last, ``[T + 1, nq]``.
        speed: along x in m/s, ``[T + 1]``; 0 on a fixed base.
        returned: rewards so far, ``[T + 1]``.
        step_seconds: simulated time of a step, s.
    """

    title: str
    design: Tensor
    entries: Sequence[str]
    camera: Camera
    poses: np.ndarray
    speed: np.ndarray
    returned: np.ndarray
    step_seconds: float

    def frames(self, stride: int) -> Iterator[np.ndarray]:
        """A labelled picture at every ``stride``-th step, ``[height, width, 3]`` uint8."""
        with self.camera:
            for t in range(0, len(self.poses), stride):
                time, speed = t * self.step_seconds, round(self.speed[t], 2) + 0.0  # no "-0.00"
                now = f"{time:.1f} s   {speed:+.2f} m/s   return {number(self.returned[t])}"
                yield labelled(self.camera.photograph(self.poses[t]), (self.title, now), self.entries)


def play(
    bodies: MorphEnv,
    policy: TensorDictModuleBase,
    designs: Tensor,
    *,
    row: int,
    title: str,
    width: int,
    height: int,
    native: bool = False,
) -> Take:
    """Play an episode twice: for the actions, and for the poses that they lead to.

    Args:
        bodies: K of them; the start of the episode is that of their next reset.
        policy: acts deterministically.
        designs: ``[K, D]``.
        row: the body that is photographed.
        title: first line of each picture.
        width: of a picture in pixels.
        height: of a picture in pixels.
        native: see `coim.run_episode`.
    """
    start = bodies.get_simulation_state()
    actions = run_episode(bodies, policy, design=designs, deterministic=True, native=native)["action"]
    bodies.set_simulation_state(start)
    bodies.reset(TensorDict({"design": designs}, bodies.batch_size))
    simulations = bodies.simulations
    poses, speed, rewards = [simulations.qpos[row].copy()], [speed_of(bodies, row)], [0.0]
    for action in actions:
        _, reward, broken = bodies.advance(action)
        poses.append(simulations.qpos[row].copy())
        speed.append(speed_of(bodies, row))
        rewards.append(float(reward[row]))
        if broken.any():
            bodies.reset(TensorDict({"_reset": broken}, bodies.batch_size))
    return Take(
        title=title,
        design=designs[row],
        entries=in_names(designs[row].tolist(), type(bodies)),
        camera=bodies.camera(row, width=width, height=height),
        poses=np.stack(poses),
        speed=np.array(speed),
        returned=np.cumsum(rewards),
        step_seconds=bodies.step_seconds,
    )


def speed_of(bodies: MorphEnv, row: int) -> float:
    """Speed of a robot along x in m/s; 0 on a fixed base."""
    return float(bodies.simulations.qvel[row, 0]) if bodies.root.unseen else 0.0


def refuse_size(width: int, height: int, steps: int | None) -> None:
    """Refuse what cannot be filmed.

    Raises:
        ValueError: if a size is odd or below 32 pixels, or there is no step to show.
    """
    for name, value in (("width", width), ("height", height)):
        if value < 32 or value % 2:
            raise ValueError(f"{name} is {value}, it must be even (H.264 halves the colours) and at least 32")
    if steps is not None and steps < 1:
        raise ValueError(f"steps is {steps}, it must be at least 1; leave it out for the whole episode")


def write_film(path: Path, takes: Sequence[Take]) -> None:
    """Film one episode, or several beside each other, in real time; the suffix is ``.mp4`` or ``.webp``.

    Raises:
        OSError: if it cannot be written.
    """
    step_seconds = takes[0].step_seconds
    stride = max(1, math.ceil(1 / (FRAMES_PER_SECOND[path.suffix] * step_seconds)))
    rate, total = 1 / (stride * step_seconds), math.ceil(len(takes[0].poses) / stride)
    together = zip(*(shot.frames(stride) for shot in takes), strict=True)
    pictures = (side_by_side(pictures) for pictures in counted(together, total, f"{path.name}: pictures"))
    write = write_webp if path.suffix == ".webp" else write_mp4
    with naming_out(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        with written_aside(path) as aside:
            write(aside, pictures, rate)


def write_mp4(path: Path, pictures: Iterable[np.ndarray], rate: float) -> None:
    """Write pictures as H.264. The preset takes 9 ms for one of 640 x 480 pixels where the default takes 14."""
    fast = ["-preset", "veryfast"]
    with imageio.get_writer(
        path, fps=rate, codec="libx264", quality=8, macro_block_size=2, output_params=fast
    ) as opened:
        writer: Any = opened  # imageio types it as a reader or a writer
        for picture in pictures:
            writer.append_data(picture)


def write_webp(path: Path, pictures: Iterable[np.ndarray], rate: float) -> None:
    """Write pictures as an animated WebP that repeats for ever, which a page shows like a picture."""
    images = (Image.fromarray(picture) for picture in pictures)
    next(images).save(
        path, save_all=True, append_images=images, duration=round(1000 / rate), loop=0, quality=WEBP_QUALITY
    )


def side_by_side(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Pictures of one size in lines of equal length, from left to right and top to bottom, filled up with white."""
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
        lines: lines of text.
        entries: words below them, as many in a line as fit; left out if all of them would cover too much of the
            picture.
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
