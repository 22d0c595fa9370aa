"""Every number of a run, typed, with the paper's values as defaults."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from coim.batches import batch_parts
from coim.experiments.run.validation import Interval, fitted, kinds_of, refuse_outside


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """Co-adapt a body and its controller (Algorithm 1). Defaults are the paper's protocol (Sec. 6.1)."""

    # -- what is asked ------------------------------------------------------------------------------------------------
    preset: Literal["paper", "quick"] = "paper"
    """paper: Sec. 6.1. quick: the same body and networks with fewer designs, episodes and updates, for a first look."""
    task: Literal["forward", "backward"] = "forward"
    """Which way the speed in the reward counts (Fig. 1, first and second row)."""
    imagine: Literal["known", "noisy", "random", "none"] = "known"
    """Designs to imagine: those tried, those with noise, uniform ones, or none (the model-free baseline)."""
    dream: Literal["ensemble", "simulator"] = "ensemble"
    """Who imagines: the learnt ensemble, or the simulator itself, which tells the ensemble's error from the rest."""
    bodies: Literal["search", "random", "fixed"] = "search"
    """Bodies after the first ones: optimised and random in turn, all random, or the first one from start to end."""
    first_design: tuple[float, ...] = ()
    """One body to begin with, as scale factors, instead of the environment's own five."""
    sigma: float = 0.1
    """Standard deviation of the noisy designs, in scale factors (Sec. 6.4)."""
    seed: int = 0
    """Seeds everything; the same seed on the same machine gives the same numbers."""
    num_runs: int = 1
    """Independent runs that advance in lock-step in this process (the run axis)."""

    # -- the protocol -------------------------------------------------------------------------------------------------
    num_designs: int = 55
    """M, bodies tried: five first designs, then optimised and random ones in turn."""
    first_episodes: int = 300
    """Episodes on each of the first designs."""
    episodes: int = 100
    """Episodes on each later design."""
    episode_steps: int = 1000
    """Steps of an episode; falling does not end it."""
    individual_updates: int = 1000
    """Updates of the individual networks after each episode."""
    population_updates: int = 250
    """Updates of the population networks after each episode."""
    model_updates: int = 250
    """Updates of the dynamics ensemble after each episode."""

    # -- soft actor-critic --------------------------------------------------------------------------------------------
    batch_size: int = 256
    """Rows in each batch."""
    num_cells: tuple[int, ...] = (200, 200, 200)
    """Hidden units of the policy and of each critic."""
    num_critics: int = 2
    """Critics; the smallest value counts."""
    alpha: float = 0.01
    """Entropy temperature, fixed."""
    gamma: float = 0.99
    """Discount."""
    tau: float = 0.005
    """Share of a critic that moves into its target after each update."""
    lr: float = 3e-4
    """Adam's learning rate of policy and critics."""
    individual_mix: float = 0.0
    """Share of an individual batch drawn from the population's replay (the predecessor's code has 0.1)."""

    # -- imagination --------------------------------------------------------------------------------------------------
    imagined_share: float = 0.2
    """Share of a population batch that is imagined (Sec. 5)."""
    individual_imagined_share: float = 0.0
    """Share of an individual batch that is imagined (0 as in Sec. 5; Algorithm 1 cites Eq. 7-8 for it too)."""
    imagined_states: Literal["stored", "matched"] = "stored"
    """What a state is under another design: as it was stored (the paper's), or with the root moved by what the legs
    differ in, without pairs that no body can be in."""
    imagined_actions: Literal["fresh", "replayed"] = "fresh"
    """Actions of imagined rows: fresh ones of the population's policy (the paper's), or those of the replay."""
    anchored: bool = False
    """Imagine what another design and action change of a real transition, instead of the whole next observation."""
    governed: bool = False
    """Take the imagined shares as the most that the model can earn, by its errors on episodes that it has not learnt
    from. Where it earns nothing, the run is the model-free baseline."""
    mix: Literal["batch", "sum"] = "batch"
    """batch: one mean over real and imagined rows (Sec. 5). sum: the two expectations of Eq. 7-8 as printed."""
    num_members: int = 3
    """Networks in the dynamics ensemble."""
    model_cells: tuple[int, ...] = (500, 500, 500)
    """Hidden units of each of them."""
    model_lr: float = 3e-4
    """Adam's learning rate of the ensemble."""
    weight_decay: float = 1e-5
    """L2 penalty of the ensemble."""
    predict: Literal["delta", "next"] = "delta"
    """What the ensemble's Gaussian is over: the change of the observation, or the next one (Eq. 6 as printed)."""

    # -- design search ------------------------------------------------------------------------------------------------
    search: Literal["swarm", "gradient"] = "swarm"
    """What maximises Eq. 5: a particle swarm (Sec. 4), or gradient ascent through the critics from many starts."""
    num_particles: int = 700
    """Particles of the swarm."""
    num_iterations: int = 250
    """Iterations of the swarm."""
    swarm_bounds: Literal["nearest", "periodic"] = "nearest"
    """What becomes of a particle that leaves the bounds: clipped, or back in on the other side (the predecessor's)."""
    num_start_states: int = 36
    """Start states that Eq. 5 averages over."""
    value_states: Literal["stored", "matched"] = "stored"
    """What a state is under the design that Eq. 5 asks about: as for imagined_states."""
    value_over: Literal["start", "visited"] = "start"
    """States that Eq. 5 averages over: those that episodes start with (the paper's), or any that were visited."""

    # -- this machine -------------------------------------------------------------------------------------------------
    precision: Literal["float32", "bfloat16"] = "float32"
    """Of the networks' products; weights, moments, targets and losses stay float32."""
    products: Literal["auto", "onednn", "torch"] = "auto"
    """Library that multiplies on the CPU: what was measured to be fastest on such a processor, or one by name. A run
    that is gone on with keeps that of its first part."""
    compile: bool = False
    """Compile the learners' gradients in the first update (torch.compile): seconds to a minute, then faster updates.
    On in preset paper."""
    device: str = "cpu"
    """Where the networks live: cpu, cuda, cuda:1, ..."""
    replay_device: Literal["same", "cpu"] = "same"
    """Where the replay lives: same as the networks, or cpu where a GPU has no room for it; batches are moved then."""
    threads: int = 0
    """Threads that may be busy at once; 0 takes one for each core that this process may use."""
    out: Path | None = None
    """Folder for the results; by default runs/ENVIRONMENT-DATE-NAME."""
    resume: Path | None = None
    """Go on with the run in this folder from its last checkpoint; its settings are read there."""
    checkpoint_every: int = 1
    """Episodes between two checkpoints."""
    name: str = "run"
    """Last part of the default folder's name."""
    wandb: Literal["off", "offline", "online"] = "off"
    """Send the numbers of the CSV files to Weights & Biases as well."""
    quiet: bool = False
    """Print nothing but errors."""


QUICK = Settings(
    preset="quick",
    num_designs=8,
    first_episodes=4,
    episodes=4,
    individual_updates=400,
    population_updates=100,
    model_updates=60,
    num_particles=100,
    num_iterations=30,
    name="quick",
)

# What a machine may not have on which a run is gone on with. Its numbers differ from there, within rounding at first.
ELSEWHERE = ("device", "replay_device", "compile")
# Settings that came later, with a default that is what all runs had before; these may be missing in a run's folder.
LATER = {"replay_device", "products", "value_states", "value_over"}
LATER |= {"imagined_states", "imagined_actions", "anchored", "governed"}
# What the parts of a run refuse in their own words, or not at all; here by the option's name and before there is a run.
ALLOWED: dict[Interval, tuple[str, ...]] = {
    Interval(1): (
        *("num_runs", "num_designs", "first_episodes", "episodes", "episode_steps", "batch_size", "checkpoint_every"),
        *("num_cells", "num_critics", "model_cells", "num_members"),
        *("num_particles", "num_iterations", "num_start_states"),
    ),
    Interval(0): (
        *("individual_updates", "population_updates", "model_updates", "seed", "threads"),
        *("sigma", "alpha", "weight_decay"),
    ),
    Interval(0, 1): ("gamma", "individual_mix", "imagined_share", "individual_imagined_share"),
    Interval(0, 1, above=True): ("tau",),
    Interval(0, above=True): ("first_design", "lr", "model_lr"),
}
LIMITS = {name: allowed for allowed, names in ALLOWED.items() for name in names}
PRESETS = {"paper": Settings(compile=True), "quick": QUICK}


def option(name: str) -> str:
    """What a setting is called on the command line."""
    return f"--{name.replace('_', '-')}"


def given(words: Sequence[str]) -> set[str]:
    """Names of the settings that are written on a command line.

    Example:
        >>> sorted(given(["--search", "gradient", "--num_particles=5", "--no-compile"]))
        ['compile', 'num_particles', 'search']
    """
    written = {word[2:].split("=")[0].replace("-", "_") for word in words if word.startswith("--")}
    return {name for name in kinds_of(Settings) if {name, f"no_{name}"} & written}


def check(settings: Settings, *, called: Callable[[str], str] = str) -> None:
    """Refuse values that no run can have, whatever its body and its machine.

    Args:
        settings: of a run.
        called: from a setting's name to what it is called where somebody wrote it.

    Raises:
        ValueError: on the first one, with its value and what it must be.

    Example:
        >>> check(Settings(episodes=0))
        Traceback (most recent call last):
        ValueError: episodes is 0, it must be at least 1
    """
    for name, kind in kinds_of(Settings).items():
        value = fitted(called(name), getattr(settings, name), kind)
        if name in LIMITS:
            refuse_outside(called(name), value, LIMITS[name])
    for name in ("num_cells", "model_cells"):
        if not getattr(settings, name):
            raise ValueError(f"{called(name)} is empty, it must have at least one number; the defaults have three")
    if settings.dream == "simulator" and settings.imagine == "none":
        raise ValueError(
            f"{called('dream')} simulator imagines nothing with {called('imagine')} none; take known, noisy or random"
        )
    if settings.dream == "simulator" and settings.governed:
        raise ValueError(
            f"{called('governed')} has no errors to go by with {called('dream')} simulator, which makes none; leave "
            "one of them out"
        )
    batch_parts(settings.batch_size, imagined=settings.imagined_share)
    batch_parts(settings.batch_size, imagined=settings.individual_imagined_share, other=settings.individual_mix)


def plain(settings: Settings) -> dict[str, Any]:
    """Settings as JSON has them."""
    return {key: str(v) if isinstance(v, Path) else v for key, v in dataclasses.asdict(settings).items()}
