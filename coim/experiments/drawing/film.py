"""Films of bodies under their policies: an episode is played again, photographed and labelled, frame by frame.

Shapes: T steps, K runs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import imageio.v2 as imageio
import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from tensordict import TensorDict

from coim.envs import MorphEnv
from coim.envs.camera import Camera
from coim.episode import run_episode
from coim.experiments.run.atomic_write import naming_out, written_aside
from coim.experiments.run.bodies import opened
from coim.experiments.run.last_words import in_names
from coim.experiments.run.progress import counted
from coim.experiments.run.records import number
from coim.run_folder import TriedDesign, policy_path
from coim.saved_run import SavedRun

PolicyName = Literal["best", "population"]

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
        policy: the policy that drives it.
        entries: entries of the design, with their names.
        camera: camera in front of its body.
        poses: joint positions before each step and after the last, ``[T + 1, nq]``.
        speed: along x in m/s, ``[T + 1]``; 0 on a fixed base.
        returned: rewards so far, ``[T + 1]``.
        step_seconds: simulated time of a step, s.
    """

    tried: TriedDesign
    policy: PolicyName
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
                best = f"best return {number(self.tried.best_return)}"
                lines = (
                    f"design {self.tried.number}, {self.tried.kind}: "
                    + (best if self.policy == "best" else "the population's policy"),
                    f"{time:.1f} s   {speed:+.2f} m/s   return {number(self.returned[t])}",
                )
                yield labelled(self.camera.photograph(self.poses[t]), lines, self.entries)


def film(
    folder: Path,
    *,
    design: str,
    run: int | None,
    steps: int | None,
    policy: PolicyName,
    body: str | None,
    out: Path | None,
    width: int,
    height: int,
) -> Iterator[Path]:
    """Write films, one after the other.

    Args:
        folder: a run folder.
        design: ``best``, ``top5``, ``all``, or a number from 1.
        run: one of the K runs; None takes the one that has the best return on these designs.
        steps: number of steps to show; None shows the whole episode.
        policy: the policy of each design's best evaluation, or the population's.
        body: class of the body, ``module:Class``; None takes the one that the run's environment names.
        out: folder for the films; None takes ``videos/`` in the run folder.
        width: width of one picture in pixels.
        height: height of one picture in pixels.

    Yields:
        Each film, when it is written.

    Raises:
        ValueError: if there is no such run, design, policy or body, or a size cannot be filmed.
        OSError: if a film cannot be written.
        RuntimeError: if this machine has no OpenGL; the message says what to install and set.
    """
    for name, value in (("width", width), ("height", height)):
        if value < 32 or value % 2:
            raise ValueError(f"{name} is {value}, it must be even (H.264 halves the colours) and at least 32")
    if steps is not None and steps < 1:
        raise ValueError(f"steps is {steps}, it must be at least 1; leave it out for the whole episode")
    torch.set_num_threads(1)  # as in training: another number could round otherwise
    loaded = opened(folder, body)
    if run is not None and not 0 <= run < loaded.bodies.numel():
        raise ValueError(f"run {run} is not in {folder}, which has runs 0 .. {loaded.bodies.numel() - 1}")
    chosen = choose(loaded, design, run)
    if policy == "best":
        refuse_lost_policies(folder, chosen)
    if steps is not None:
        loaded.bodies.episode_steps = steps
    together = [chosen] if design == "top5" else [[tried] for tried in chosen]
    for designs in together:
        words = ["top5" if design == "top5" else f"design-{designs[0].number}"]
        if loaded.bodies.numel() > 1:
            words.insert(0, f"run-{designs[0].run}")
        if policy == "population":
            words.append(policy)
        path = (out or folder / "videos") / f"{'-'.join(words)}.mp4"
        write_film(path, [take(loaded, tried, policy, width, height) for tried in designs])
        yield path


def refuse_lost_policies(folder: Path, chosen: Sequence[TriedDesign]) -> None:
    """Refuse designs whose policy is not in the folder.

    Raises:
        ValueError: with the designs, and the policy that can be filmed instead.
    """
    lost = sorted({tried.number for tried in chosen if not policy_path(folder, tried.number).is_file()})
    if lost:
        raise ValueError(
            f"{folder} keeps no policy of design {', '.join(map(str, lost))}; add --policy population to film the "
            "population's policy, which serves every design"
        )


def choose(loaded: SavedRun, design: str, run: int | None) -> list[TriedDesign]:
    """The designs to film, all from one run; ``top5`` has the best first.

    Raises:
        ValueError: if the run folder has no such design with a return.
    """
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


def take(loaded: SavedRun, tried: TriedDesign, policy: PolicyName, width: int, height: int) -> Take:
    """Play an episode of a design twice: for the actions, and for the poses that they lead to."""
    bodies, row = loaded.bodies, tried.run
    if policy == "best":
        design, network = loaded.rewind(tried.number), loaded.policy_of(tried.number)
    else:
        same = {other.run: other.design for other in loaded.designs if other.number == tried.number}
        design = torch.stack([same.get(other, tried.design) for other in range(bodies.numel())])
        network = loaded.population.policy
    start = bodies.get_simulation_state()
    actions = run_episode(bodies, network, design=design, deterministic=True)["action"]
    bodies.set_simulation_state(start)
    bodies.reset(TensorDict({"design": design}, bodies.batch_size))
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
        tried=tried,
        policy=policy,
        entries=in_names(tried.design.tolist(), type(bodies)),
        camera=bodies.camera(row, width=width, height=height),
        poses=np.stack(poses),
        speed=np.array(speed),
        returned=np.cumsum(rewards),
        step_seconds=bodies.step_seconds,
    )


def speed_of(bodies: MorphEnv, row: int) -> float:
    """Speed of a robot along x in m/s; 0 on a fixed base."""
    return float(bodies.simulations.qvel[row, 0]) if bodies.root.unseen else 0.0


def write_film(path: Path, takes: Sequence[Take]) -> None:
    """Film one episode, or several beside each other, in real time."""
    step_seconds = takes[0].step_seconds
    stride = max(1, math.ceil(1 / (FRAMES_PER_SECOND * step_seconds)))
    rate, total = 1 / (stride * step_seconds), math.ceil(len(takes[0].poses) / stride)
    together = zip(*(shot.frames(stride) for shot in takes), strict=True)
    with naming_out(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        with (
            written_aside(path) as aside,
            imageio.get_writer(aside, fps=rate, codec="libx264", quality=8, macro_block_size=2) as opened_file,
        ):
            writer: Any = opened_file  # imageio types it as a reader or a writer
            for pictures in counted(together, total, f"{path.name}: pictures"):
                writer.append_data(side_by_side(pictures))


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
