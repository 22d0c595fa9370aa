"""Every number of a run, typed, with the paper's values as defaults."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from coim.batches import batch_parts
from coim.experiments.run.pydantic_errors import CONFIG, refused_in_words

Count = Annotated[int, Field(ge=1)]
Amount = Annotated[int, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
LISTS = Field(strict=False)  # become tuples
Widths = Annotated[tuple[Count, ...], LISTS, Field(min_length=1)]
Task = Literal["forward", "backward"]


@refused_in_words
@dataclass(frozen=True, kw_only=True, config=CONFIG)
class Settings:
    """Co-adapt a body and its controller (Algorithm 1). Defaults are the paper's protocol (Sec. 6.1).

    Raises:
        ValueError: on a value of another type or out of range, on an unknown name, and on values that contradict each
            other, whatever the body and the machine.

    Example:
        >>> Settings(episodes=0)
        Traceback (most recent call last):
        ValueError: episodes is 0, it must be at least 1
    """

    # -- what is asked ------------------------------------------------------------------------------------------------
    preset: Literal["paper", "quick"] = "paper"
    """paper: Sec. 6.1. quick: the same body and networks with fewer designs, episodes and updates, for a first look."""
    task: Task = "forward"
    """Which way the speed in the reward counts (Fig. 1, first and second row)."""
    imagine: Literal["known", "noisy", "random", "none"] = "known"
    """Designs to imagine: those tried, those with noise, uniform ones, or none (the model-free baseline)."""
    dream: Literal["ensemble", "simulator"] = "ensemble"
    """Who imagines: the learnt ensemble, or the simulator itself, which tells the ensemble's error from the rest."""
    bodies: Literal["search", "random", "fixed"] = "search"
    """Bodies after the first ones: optimised and random in turn, all random, or the first one from start to end."""
    first_design: Annotated[tuple[Positive, ...], LISTS] = ()
    """One body to begin with, as scale factors, instead of the environment's own five."""
    sigma: NonNegative = 0.1
    """Standard deviation of the noisy designs, in scale factors (Sec. 6.4)."""
    seed: Amount = 0
    """Seeds everything; the same seed on the same machine gives the same numbers."""
    num_runs: Count = 1
    """Independent runs that advance in lock-step in this process (the run axis)."""

    # -- the protocol -------------------------------------------------------------------------------------------------
    num_designs: Count = 55
    """M, bodies tried: five first designs, then optimised and random ones in turn."""
    first_episodes: Count = 300
    """Episodes on each of the first designs."""
    episodes: Count = 100
    """Episodes on each later design."""
    episode_steps: Count = 1000
    """Steps of an episode; falling does not end it."""
    individual_updates: Amount = 1000
    """Updates of the individual networks after each episode."""
    population_updates: Amount = 250
    """Updates of the population networks after each episode."""
    model_updates: Amount = 250
    """Updates of the dynamics ensemble after each episode."""

    # -- soft actor-critic --------------------------------------------------------------------------------------------
    batch_size: Count = 256
    """Rows in each batch."""
    num_cells: Widths = (200, 200, 200)
    """Hidden units of the policy and of each critic."""
    num_critics: Count = 2
    """Critics; the smallest value counts."""
    alpha: NonNegative = 0.01
    """Entropy temperature, fixed."""
    gamma: Share = 0.99
    """Discount."""
    tau: Annotated[float, Field(gt=0, le=1)] = 0.005
    """Share of a critic that moves into its target after each update."""
    lr: Positive = 3e-4
    """Adam's learning rate of policy and critics."""
    individual_mix: Share = 0.0
    """Share of an individual batch drawn from the population's replay (the predecessor's code has 0.1)."""

    # -- imagination --------------------------------------------------------------------------------------------------
    imagined_share: Share = 0.2
    """Share of a population batch that is imagined (Sec. 5)."""
    individual_imagined_share: Share = 0.0
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
    num_members: Count = 3
    """Networks in the dynamics ensemble."""
    model_cells: Widths = (500, 500, 500)
    """Hidden units of each of them."""
    model_lr: Positive = 3e-4
    """Adam's learning rate of the ensemble."""
    weight_decay: NonNegative = 1e-5
    """L2 penalty of the ensemble."""
    predict: Literal["delta", "next"] = "delta"
    """What the ensemble's Gaussian is over: the change of the observation, or the next one (Eq. 6 as printed)."""

    # -- design search ------------------------------------------------------------------------------------------------
    search: Literal["swarm", "gradient"] = "swarm"
    """What maximises Eq. 5: a particle swarm (Sec. 4), or gradient ascent through the critics from many starts."""
    num_particles: Count = 700
    """Particles of the swarm."""
    num_iterations: Count = 250
    """Iterations of the swarm."""
    swarm_bounds: Literal["nearest", "periodic"] = "nearest"
    """What becomes of a particle that leaves the bounds: clipped, or back in on the other side (the predecessor's)."""
    num_start_states: Count = 36
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
    threads: Amount = 0
    """Threads that may be busy at once; 0 takes one for each core that this process may use."""
    out: Path | None = None
    """Folder for the results; by default runs/ENVIRONMENT-DATE-NAME."""
    resume: Path | None = None
    """Go on with the run in this folder from its last checkpoint; its settings are read there."""
    checkpoint_every: Count = 1
    """Episodes between two checkpoints."""
    name: str = "run"
    """Last part of the default folder's name."""
    wandb: Literal["off", "offline", "online"] = "off"
    """Send the numbers of the CSV files to Weights & Biases as well."""
    quiet: bool = False
    """Print nothing but errors."""

    def __post_init__(self) -> None:  # errors have the names of settings in backticks, for `pydantic_errors.sentence`
        if self.dream == "simulator" and self.imagine == "none":
            raise ValueError("`dream` simulator imagines nothing with `imagine` none; take known, noisy or random")
        if self.dream == "simulator" and self.governed:
            raise ValueError(
                "`governed` has no errors to go by with `dream` simulator, which makes none; leave one of them out"
            )
        batch_parts(self.batch_size, imagined=self.imagined_share)
        batch_parts(self.batch_size, imagined=self.individual_imagined_share, other=self.individual_mix)


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
FIELDS = {field.name for field in dataclasses.fields(Settings)}
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
    return {name for name in FIELDS if {name, f"no_{name}"} & written}


def plain(settings: Settings) -> dict[str, Any]:
    """Settings as JSON has them."""
    return {key: str(v) if isinstance(v, Path) else v for key, v in dataclasses.asdict(settings).items()}
