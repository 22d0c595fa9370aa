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
    """paper: the protocol of Sec. 6.1. quick: 8 bodies and small networks, for a first look."""
    task: Task = "forward"
    """Direction in which speed is rewarded (Fig. 1, first and second row)."""
    imagine: Literal["known", "noisy", "random", "none"] = "known"
    """Designs to imagine: those tried, those with noise, uniform ones, or none (the model-free baseline)."""
    dream: Literal["ensemble", "simulator"] = "ensemble"
    """Model that imagines: the learnt ensemble, or the simulator, which shows what the ensemble's error costs."""
    bodies: Literal["search", "random", "fixed"] = "search"
    """Bodies after the first ones: optimised and random in turn, all random, or always the first one."""
    first_design: Annotated[tuple[Positive, ...], LISTS] = ()
    """First body, as scale factors, in place of the environment's own first bodies; or, one after the other, a body for
    each of --num-runs."""
    sigma: NonNegative = 0.1
    """Standard deviation of the noise of --imagine noisy, in scale factors (Sec. 6.4)."""
    seed: Amount = 0
    """Seed of all random numbers. The same seed on the same machine gives the same numbers."""
    num_runs: Count = 1
    """Seeds trained together in one process; each is an independent run."""

    # -- the protocol -------------------------------------------------------------------------------------------------
    num_designs: Count = 55
    """Bodies to try (the paper's M): the first ones, then optimised and random ones in turn."""
    first_episodes: Count = 300
    """Episodes on each of the first designs."""
    episodes: Count = 100
    """Episodes on each later design."""
    episode_steps: Count = 1000
    """Steps of an episode. A fall does not end it."""
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
    """Critics. The smallest of their values counts."""
    alpha: NonNegative = 0.01
    """Entropy temperature; it stays fixed."""
    gamma: Share = 0.99
    """Discount."""
    tau: Annotated[float, Field(gt=0, le=1)] = 0.005
    """Share of a critic that moves into its target after each update."""
    lr: Positive = 3e-4
    """Adam's learning rate of policy and critics."""
    individual_mix: Share = 0.0
    """Share of an individual batch from the population's replay (0.1 in the code of the paper's predecessor)."""

    # -- imagination --------------------------------------------------------------------------------------------------
    imagined_share: Share = 0.2
    """Share of a population batch that is imagined (Sec. 5)."""
    individual_imagined_share: Share = 0.0
    """Share of an individual batch that is imagined (Sec. 5: 0; Algorithm 1 cites Eq. 7-8 here too)."""
    imagined_states: Literal["stored", "matched"] = "stored"
    """State under another design. stored: unchanged (the paper). matched: with the same clearance to the floor."""
    imagined_actions: Literal["fresh", "replayed"] = "fresh"
    """Actions of imagined rows: fresh from the population's policy (the paper), or replayed from its replay."""
    anchored: bool = False
    """Imagine how a real transition changes with the design and the action, not the whole next observation."""
    governed: bool = False
    """Let the model's error set how much is imagined, at most the imagined shares; a poor model imagines nothing."""
    mix: Literal["batch", "sum"] = "batch"
    """batch: one mean over real and imagined rows (Sec. 5). sum: the sum of two expectations (Eq. 7-8 as printed)."""
    num_members: Count = 3
    """Networks of the dynamics ensemble."""
    model_cells: Widths = (500, 500, 500)
    """Hidden units of each network of the ensemble."""
    model_lr: Positive = 3e-4
    """Adam's learning rate of the ensemble."""
    weight_decay: NonNegative = 1e-5
    """L2 penalty of the ensemble."""
    predict: Literal["delta", "next"] = "delta"
    """Output of the ensemble: the change of the observation, or the next observation (Eq. 6 as printed)."""

    # -- design search ------------------------------------------------------------------------------------------------
    search: Literal["swarm", "gradient"] = "swarm"
    """Search that maximises Eq. 5: a particle swarm (Sec. 4), or gradient ascent from many starts."""
    num_particles: Count = 700
    """Particles of the swarm."""
    num_iterations: Count = 250
    """Iterations of the swarm."""
    swarm_bounds: Literal["nearest", "periodic"] = "nearest"
    """nearest: a particle outside the bounds is clipped. periodic: it enters on the other side (the predecessor)."""
    num_start_states: Count = 36
    """Start states in the mean of Eq. 5."""
    value_states: Literal["stored", "matched"] = "stored"
    """State under the design that Eq. 5 asks about: stored or matched, as in --imagined-states."""
    value_over: Literal["start", "visited"] = "start"
    """States in the mean of Eq. 5: states at the start of episodes (the paper), or all states visited."""
    chosen_by: Literal["value", "returns", "posterior"] = "value"
    """What the search maximises: Eq. 5 (the paper), a Gaussian process over the returns earned so far, or the same with
    Eq. 5 as its mean."""
    reach: Annotated[float, Field(gt=0, le=1)] | None = None
    """Search only this far around the best body so far, as a share of each entry's range; by default everywhere."""
    widening: NonNegative = 0.0
    """Added to the reach for each body after the first ones."""

    # -- this machine -------------------------------------------------------------------------------------------------
    precision: Literal["float32", "bfloat16"] = "float32"
    """Precision of the networks' products. Weights, moments, targets and losses are always float32."""
    products: Literal["auto", "onednn", "torch"] = "auto"
    """Library that multiplies on the CPU; auto takes the fastest known. A resumed run keeps the one it has."""
    compile: bool = False
    """Compute the updates by compiled code: on a CPU native code, which a C++ compiler makes in five seconds, for
    float32 and up to 256 units in a layer, of the model 512 with AVX2; on a GPU that of torch.compile. On in both
    presets."""
    native_episodes: bool = False
    """Run episodes in native code, which a C++ compiler makes in a second: a third to a seventh of the time for one
    body. On in both presets; actions differ by roundings."""
    device: str = "cpu"
    """Device of the networks: cpu, cuda, cuda:1, ..."""
    replay_device: Literal["same", "cpu"] = "same"
    """Device of the replay: same as the networks, or cpu if the GPU has too little memory for it."""
    threads: Amount = 0
    """Threads to use at once; 0 uses one for each core available to this process."""
    out: Path | None = None
    """Folder for the results; by default runs/ENVIRONMENT-DATE-NAME."""
    resume: Path | None = None
    """Folder of a run to resume from its last checkpoint, with the settings in that folder."""
    checkpoint_every: Count = 1
    """Episodes between two checkpoints."""
    name: str = "run"
    """Last part of the name of the default folder."""
    log: Literal["off", "tensorboard", "trackio", "wandb", "wandb-offline"] = "off"
    """Also send the numbers of the CSV files to TensorBoard, trackio or Weights & Biases; wandb needs an account."""
    wandb: Literal["off", "offline", "online"] = "off"
    """The former name of --log wandb (online) and --log wandb-offline (offline)."""
    quiet: bool = False
    """Print errors only."""

    def __post_init__(self) -> None:  # errors have the names of settings in backticks, for `pydantic_errors.sentence`
        if "/" in self.name:
            raise ValueError(f"`name` is {self.name!r}, the end of a folder's name; leave out the /, or give --out")
        if self.widening and self.reach is None:
            raise ValueError(
                f"`widening` is {self.widening} without a `reach` that it could widen; give one, such as 0.25"
            )
        if self.dream == "simulator" and self.imagine == "none":
            raise ValueError("`dream` simulator imagines nothing with `imagine` none; take known, noisy or random")
        if self.dream == "simulator" and self.governed:
            raise ValueError(
                "`governed` has no errors to go by with `dream` simulator, which makes none; leave one of them out"
            )
        if self.governed and self.mix == "sum":
            raise ValueError(
                "`governed` sets the share of imagined rows, and with `mix` sum they count as much as all real ones, "
                "whatever their share; take batch, or leave governed out"
            )
        if self.governed and self.num_members < 2:
            raise ValueError(
                "`governed` asks how far the members of the model disagree, and `num_members` is 1; take 2 or more"
            )
        batch_parts(self.batch_size, imagined=self.imagined_share)
        batch_parts(self.batch_size, imagined=self.individual_imagined_share, other=self.individual_mix)


# Ways to choose the next body, by name: what `--method` sets. docs/results/choosing.md and bodies.md compare them.
METHODS: dict[str, dict[str, Any]] = {
    "paper": {"chosen_by": "value", "value_states": "stored", "value_over": "start", "reach": None, "widening": 0.0},
    "grounded": {
        "chosen_by": "posterior",
        "value_states": "matched",
        "value_over": "visited",
        # On three seeds the first bodies that were chosen from the whole space earned a third of what random ones did.
        "reach": 0.25,
        "widening": 0.1,
    },
    # On ten further seeds its bodies earned 238 more than those of grounded (138 to 337).
    "returns": {
        "chosen_by": "returns",
        "value_states": "stored",
        "value_over": "start",
        "reach": None,
        "widening": 0.0,
    },
}

QUICK = Settings(
    preset="quick",
    **METHODS["returns"],
    num_designs=8,
    first_episodes=6,
    episodes=6,
    num_cells=(64, 64, 64),
    model_cells=(200, 200, 200),
    model_updates=100,
    search="gradient",
    compile=True,
    native_episodes=True,
    name="quick",
)

FIELDS = {field.name for field in dataclasses.fields(Settings)}
PRESETS = {"paper": Settings(compile=True, native_episodes=True), "quick": QUICK}


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
