"""Films of bodies under their policies: those of a run, or one that was exported.

Shapes: K runs, D design.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import torch

from coim.experiments.drawing.footage import Take, play, refuse_size, write_film
from coim.experiments.export.taken import take as take_policy
from coim.experiments.run.bodies import opened
from coim.experiments.run.records import number
from coim.run_folder import TriedDesign, policy_path
from coim.saved_run import SavedRun

PolicyName = Literal["best", "population"]
Format = Literal["mp4", "webp"]
TOP = 5


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
    format: Format,
) -> Iterator[Path]:
    """Write films, one after the other.

    Args:
        folder: a run folder.
        design: ``best``, ``top5``, ``all``, a number from 1, or several with commas between them.
        run: one of the K runs; None takes the one that has the best return on these designs.
        steps: number of steps to show; None shows the whole episode.
        policy: the policy of each design's best evaluation, or the population's.
        body: class of the body, ``module:Class``; None takes the one that the run's environment names.
        out: folder for the films; None takes ``videos/`` in the run folder.
        width: width of one picture in pixels.
        height: height of one picture in pixels.
        format: of the files.

    Yields:
        Each film, when it is written.

    Raises:
        ValueError: if there is no such run, design, policy or body, or a size cannot be filmed.
        OSError: if a film cannot be written.
        RuntimeError: if this machine has no OpenGL; the message says what to install and set.
    """
    refuse_size(width, height, steps)
    torch.set_num_threads(1)  # as in training: another number could round otherwise
    loaded = opened(folder, body)
    if run is not None and not 0 <= run < loaded.bodies.numel():
        raise ValueError(f"run {run} is not in {folder}, which has runs 0 .. {loaded.bodies.numel() - 1}")
    chosen = choose(loaded, design, run)
    if policy == "best":
        refuse_lost_policies(folder, chosen)
    if steps is not None:
        loaded.bodies.episode_steps = steps
    together = [chosen] if design == "top5" or "," in design else [[tried] for tried in chosen]
    for designs in together:
        words = ["top5" if design == "top5" else "-".join(["design", *(str(tried.number) for tried in designs)])]
        if loaded.bodies.numel() > 1:
            words.insert(0, f"run-{designs[0].run}")
        if policy == "population":
            words.append(policy)
        path = (out or folder / "videos") / f"{'-'.join(words)}.{format}"
        write_film(path, [take(loaded, tried, policy, width, height) for tried in designs])
        yield path


def film_policy(
    source: Path,
    *,
    design: str,
    steps: int | None,
    seconds: float | None = None,
    body: str | None,
    out: Path,
    width: int,
    height: int,
    format: Format,
) -> Path:
    """Film a policy that was exported.

    Args:
        source: a file of ``coim export``.
        design: ``best`` for its own body, or factors with commas between them.
        steps: number of steps to show.
        seconds: simulated time to show if no number of steps is given; None shows the whole episode.
        body: class of the body, ``module:Class``; None takes the one that the file names.
        out: folder for the film.
        width: width of the picture in pixels.
        height: height of the picture in pixels.
        format: of the film.

    Returns:
        The film.

    Raises:
        ValueError: if there is no such file, design or body, or a size cannot be filmed.
        OSError: if the film cannot be written.
        RuntimeError: if this machine has no OpenGL; the message says what to install and set.
    """
    refuse_size(width, height, steps)
    torch.set_num_threads(1)
    taken = take_policy(source, design, run=None, policy=None, body=body)
    bodies = taken.bodies(1, seed=0)
    if steps is None and seconds is not None:
        steps = min(bodies.episode_steps, math.ceil(seconds / bodies.step_seconds))
    bodies.episode_steps = steps or bodies.episode_steps
    path = out / f"{source.stem}.{format}"
    shot = play(bodies, taken.policy, taken.design[None], row=0, title=taken.name, width=width, height=height)
    write_film(path, [shot])
    return path


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
    """The designs to film, all from one run; ``top5`` has the best first, numbers are in the order that is asked for.

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
    asked = [] if design in ("best", "top5", "all") else design.split(",")
    done = sorted({tried.number for tried in ranked})
    ranked = [tried for tried in ranked if not asked or str(tried.number) in asked]
    own = [tried for tried in ranked if tried.run == ranked[0].run]
    if len(own) < len(asked):
        raise ValueError(
            f"--design is {design!r}: choose best, top5, all or numbers of the designs that are done{whose}, {done}"
        )
    if asked:
        return sorted(own, key=lambda tried: asked.index(str(tried.number)))
    if design == "all":
        return sorted(own, key=lambda tried: tried.number)
    return own[: TOP if design == "top5" else 1]


def take(loaded: SavedRun, tried: TriedDesign, policy: PolicyName, width: int, height: int) -> Take:
    """Play an episode of a design: its best evaluation, or one of the population's policy."""
    title = f"design {tried.number}, {tried.kind}: "
    if policy == "best":
        title += f"best return {number(tried.best_return)}"
        designs, network = loaded.rewind(tried.number), loaded.policy_of(tried.number)
    else:
        title += "the population's policy"
        same = {other.run: other.design for other in loaded.designs if other.number == tried.number}
        designs = torch.stack([same.get(other, tried.design) for other in range(loaded.bodies.numel())])
        network = loaded.population.policy
    native = loaded.acts_natively
    return play(loaded.bodies, network, designs, row=tried.run, title=title, width=width, height=height, native=native)
