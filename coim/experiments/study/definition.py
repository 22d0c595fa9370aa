"""A study: environments x tasks x arms x seeds under one protocol, with one run per cell."""

from __future__ import annotations

import dataclasses
import itertools
import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, Field, TypeAdapter, ValidationError, ValidationInfo
from pydantic.dataclasses import dataclass

from coim.envs import BODIES
from coim.experiments.run.effect import without_effect
from coim.experiments.run.pydantic_errors import CONFIG, refused_in_words, sentence
from coim.experiments.run.settings import FIELDS, LISTS, PRESETS, Amount, Count, Settings, Task
from coim.experiments.study.arms import ARMS, arm_named, in_order

PAPER = PRESETS["paper"]
Protocol = Literal["paper", "preview", "pilot", "smoke"]
PROTOCOLS: dict[str, Settings] = {
    "paper": PAPER,
    # About nine hours of one core, five of two, for the study of this name with its 26 runs: on the machine of
    # docs/results an episode takes 8 s without and 12.5 s with imagination, a seventh more when both cores are busy.
    # The first designs stay five, as they are the paper's; ten more let five be optimised; and six episodes each are
    # 6,000 updates of a controller that starts from the population's. Few episodes at the start would leave Eq. 5 to
    # critics that know little, so all designs get the same. The gradient search finds what the swarm finds (Q of
    # 1.00 - 1.01 of the swarm's) in 7 % of its time. bfloat16 would allow a third more episodes, but is not shown to
    # cost nothing.
    "preview": dataclasses.replace(PAPER, num_designs=15, first_episodes=6, episodes=6, search="gradient"),
    # For comparing ways of choosing bodies on two cores: 20 bodies let eight be chosen. With seed 0 of coim run hopper
    # --imagine none --bodies random --num-designs 8 --first-episodes 16 --episodes 16 --num-cells 64 64 64 the eight
    # bodies had earned 1,179 on the mean after six episodes (441 to 2,259); with half as many updates after each, 867
    # after twelve. Networks of 3 x 200 units were not compared.
    # A model of 3 x 64 units foresees the first episode of a Hopper with an error of 0.55 at the median, 3 x 500 with
    # 0.50 (docs/results/README.md, "Imagined rows"), and learns from an episode in 0.3 s, where 3 x 500 take 5 s.
    "pilot": dataclasses.replace(
        PAPER,
        num_designs=20,
        first_episodes=6,
        episodes=6,
        search="gradient",
        num_cells=(64, 64, 64),
        model_cells=(64, 64, 64),
    ),
    "smoke": Settings(
        num_designs=6,
        first_episodes=1,
        episodes=1,
        episode_steps=6,
        num_cells=(8,),
        model_cells=(8,),
        individual_updates=2,
        population_updates=2,
        model_updates=2,
        batch_size=10,
        num_particles=4,
        num_iterations=2,
        num_start_states=3,
    ),
}
# Of the cell or of the machine that it runs on, never of a study.
OF_THE_CELL = {"preset", "task", "imagine", "bodies", "dream", "seed", "num_runs", "threads"}
OF_THE_CELL |= {"out", "resume", "name", "quiet"}


Value = TypeVar("Value")


def each_once(values: tuple[Value, ...], field: ValidationInfo) -> tuple[Value, ...]:
    """Refuse a value that comes twice."""
    if twice := sorted({repr(value) for value in values if values.count(value) > 1}):
        raise ValueError(f"{field.field_name} has {', '.join(twice)} more than once; name each of them once")
    return values


def known_body(name: str) -> str:
    """Refuse the name of no body."""
    if name not in BODIES:
        raise ValueError(f"{name!r} is no environment; there are {', '.join(BODIES)}")
    return name


def known_arm(name: str) -> str:
    """Refuse the name of no arm."""
    return arm_named(name).name


def of_a_study(overrides: Mapping[str, Any]) -> Mapping[str, Any]:
    """Refuse a setting that no study can set."""
    if other := sorted(overrides.keys() - (FIELDS - OF_THE_CELL)):
        raise ValueError(
            f"overrides of {', '.join(other)} are not possible; a study may set "
            f"{', '.join(sorted(FIELDS - OF_THE_CELL))}"
        )
    return overrides


SOME = (LISTS, Field(min_length=1), AfterValidator(each_once))


@refused_in_words
@dataclass(frozen=True, kw_only=True, config=CONFIG)
class Block:
    """Every combination of what is listed here."""

    environments: Annotated[tuple[Annotated[str, AfterValidator(known_body)], ...], *SOME]
    """Names of bodies."""
    arms: Annotated[tuple[Annotated[str, AfterValidator(known_arm)], ...], *SOME]
    """Names of arms, as `coim.experiments.study.arms.ARMS` has them."""
    seeds: Annotated[tuple[Amount, ...], *SOME]
    """Shared by all arms, which makes every comparison one of pairs."""
    tasks: Annotated[tuple[Task, ...], *SOME] = ("forward",)
    """Directions in which the speed in the reward counts."""
    overrides: Annotated[Mapping[str, Any], AfterValidator(of_a_study)] = dataclasses.field(default_factory=dict)
    """Settings that differ from the protocol's; those of a study hold in all of its blocks."""


@refused_in_words
@dataclass(frozen=True, kw_only=True, config=CONFIG)
class Study(Block):
    """A block, and more of them where not everything is combined with everything.

    Raises:
        ValueError: if a name is not known, a seed comes twice, a cell has settings that no run can have, or an override
            changes nothing in any cell, or is one that an arm sets itself: it would change the other arms alone.

    Example:
        >>> study = Study(name="tiny", environments=("hopper",), arms=("none", "known"), seeds=(0, 1), protocol="smoke")
        >>> [cell.name for cell in study.cells()]  # doctest: +NORMALIZE_WHITESPACE
        ['hopper-forward-none-0', 'hopper-forward-known-0', 'hopper-forward-none-1', 'hopper-forward-known-1']
    """

    name: str
    """Name of the study, and of its folder if no other is given."""
    protocol: Protocol = "paper"
    """paper: Sec. 6.1. preview: the same networks and updates with fewer designs and episodes. pilot: small networks,
    20 bodies. smoke: seconds."""
    seeds_per_cell: Count = 1
    """Seeds trained together in one cell, for a GPU. The first of them seeds all."""
    blocks: Annotated[tuple[Block, ...], LISTS] = ()
    """More combinations."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"\w[\w .-]*", self.name):
            raise ValueError(f"the study's name is {self.name!r}; letters, digits, dots and hyphens name a folder")
        names = [
            "-".join(map(str, place))
            for block in (self, *self.blocks)
            for place in itertools.product(block.environments, block.tasks, block.arms, block.seeds)
        ]
        if twice := sorted(name for name, times in Counter(names).items() if times > 1):
            raise ValueError(f"{', '.join(twice)} would be made twice; take it out of all but one block")
        for cell in self.cells():
            refuse_unbuildable(cell)
        self._refuse_without_effect(self.overrides, self.cells())
        for block in self.blocks:
            self._refuse_without_effect(block.overrides, list(self._cells_of(block)))

    def cells(self) -> list[Cell]:
        """The runs of this study: one seed of every arm before the next, so that what there is can be compared."""
        columns = [list(self._cells_of(block)) for block in (self, *self.blocks)]
        cells = itertools.chain.from_iterable(columns)
        return sorted(cells, key=lambda cell: cell.position)  # stable: within a position in the order of the blocks

    def _refuse_without_effect(self, overrides: Mapping[str, Any], cells: Sequence[Cell]) -> None:
        """Refuse an override that changes nothing in any of the cells that it is meant for, or not in all arms."""
        idle = [without_effect(cell.settings) for cell in cells]
        for name in overrides:
            if own := [arm for arm in in_order(cell.arm for cell in cells) if name in ARMS[arm].settings]:
                raise ValueError(
                    f"the override of {name} does not reach {', '.join(own)}, as these arms set it themselves; leave "
                    "it out, or give it to the other arms in a block of theirs"
                )
            if all(name in found for found in idle):
                raise ValueError(f"in the overrides {idle[0][name]}")

    def _cells_of(self, block: Block) -> Iterator[Cell]:
        overrides = {**self.overrides, **block.overrides}
        for position in range(0, len(block.seeds), self.seeds_per_cell):
            seeds = block.seeds[position : position + self.seeds_per_cell]
            for environment, task, arm in itertools.product(block.environments, block.tasks, block.arms):
                settings = dataclasses.replace(
                    PROTOCOLS[self.protocol],
                    **{**overrides, **ARMS[arm].settings},
                    task=task,
                    seed=seeds[0],
                    num_runs=len(seeds),
                    name=self.name,
                    quiet=True,
                )
                yield Cell(environment, arm, settings, position)


@dataclasses.dataclass(frozen=True)
class Cell:
    """One run of a study.

    Attributes:
        environment: name of the body.
        arm: name of the arm.
        settings: of the run but for its folder and its threads.
        position: of its seed among the seeds.
    """

    environment: str
    arm: str
    settings: Settings
    position: int

    @property
    def name(self) -> str:
        """Name of the cell's folder."""
        return f"{self.environment}-{self.settings.task}-{self.arm}-{self.settings.seed}"


def refuse_unbuildable(cell: Cell) -> None:
    """Refuse a first design that is no design of a cell's body.

    Raises:
        ValueError: with the design and what that body's designs are.
    """
    design, body = cell.settings.first_design, BODIES[cell.environment]
    low, high = (bound.tolist() for bound in body.design_bounds())
    bounds = itertools.cycle(zip(low, high))
    sizes = (body.DESIGN_SIZE, body.DESIGN_SIZE * cell.settings.num_runs)  # one for all runs, or one for each
    fits = len(design) in sizes and all(x <= factor <= y for factor, (x, y) in zip(design, bounds))
    if design and not fits:
        raise ValueError(
            f"first_design is {design}, a design of {cell.environment} has {body.DESIGN_SIZE} scale factors from "
            f"{low[0] if len(set(low)) == 1 else low} to {high[0] if len(set(high)) == 1 else high}; write such, "
            f"or {sizes[1]} numbers, one design for each of the {cell.settings.num_runs} run(s) of the cell with seed "
            f"{cell.settings.seed}, and one for each environment in the overrides of a block of its own"
        )


def to_json(study: Study) -> str:
    """A study as a file."""
    return json.dumps(dataclasses.asdict(study), indent=2) + "\n"


def from_json(path: Path) -> Study:
    """A study from a file.

    Raises:
        ValueError: if it cannot be read, or is no study.
    """
    try:
        return TypeAdapter(Study).validate_json(path.read_bytes())
    except OSError as error:
        raise ValueError(f"{path} cannot be read ({error.strerror})") from None
    except ValidationError as error:
        raise ValueError(f"{path} is no study: {sentence(error, Study)}") from None
