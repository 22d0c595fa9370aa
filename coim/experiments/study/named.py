"""The studies that have a name."""

from __future__ import annotations

from coim.experiments.study.definition import Block, Study

SEEDS = tuple(range(10))
# A method is developed on the first seeds and confirmed on the others, by which nothing may be chosen.
DEVELOP, CONFIRM, FLEET = tuple(range(5)), tuple(range(20, 30)), tuple(range(30, 40))
REACH, OTHERS, AGAIN = tuple(range(40, 50)), tuple(range(50, 60)), tuple(range(60, 70))


def bodies(name: str, seeds: tuple[int, ...]) -> Study:
    """Ways of choosing bodies, all without imagination."""
    arms = ("none", "random-bodies", "matched", "visited", "returns", "posterior", "grounded")
    return Study(name=name, environments=("hopper",), arms=arms, seeds=seeds, protocol="pilot")


def bodies_with_and_without_reach() -> Study:
    """Whether it pays to search near the best body at first, as `grounded` does and the others do not."""
    arms = ("grounded", "posterior", "returns", "random-bodies")
    return Study(name="bodies-reach", environments=("hopper",), arms=arms, seeds=REACH, protocol="pilot")


def bodies_of_other_robots() -> Study:
    """Whether `returns`, which was found on the hopper, gains on robots that it was not made with."""
    robots, arms = ("walker", "half_cheetah"), ("returns", "random-bodies")
    return Study(name="bodies-others", environments=robots, arms=arms, seeds=OTHERS, protocol="pilot")


def bodies_in_fleets() -> Study:
    """Ways of choosing bodies on seeds of their own, ten runs in lock-step in each cell for a GPU, on three bodies."""
    return Study(
        name="bodies-fleet",
        environments=("hopper",),
        arms=("none", "random-bodies", "returns", "grounded"),
        seeds=FLEET,
        protocol="pilot",
        seeds_per_cell=len(FLEET),
        overrides={"compile": False, "checkpoint_every": 6},
        blocks=(Block(environments=("half_cheetah", "walker"), arms=("none", "grounded"), seeds=FLEET),),
    )


def imagining(name: str, seeds: tuple[int, ...]) -> Study:
    """What to imagine where bodies are chosen as `grounded` does; on the Half-Cheetah fewer arms, to save hours."""
    kept = ("grounded", "grounded-governed-both", "grounded-governed")
    others = ("known", "random-anchored", "noisy", "random", "noisy-anchored")
    return Study(
        name=name,
        environments=("hopper",),
        arms=(*kept, *(f"grounded-{other}" for other in others)),
        seeds=seeds,
        protocol="pilot",
        blocks=(Block(environments=("half_cheetah",), arms=kept, seeds=seeds),),
    )


def imagining_with_returns() -> Study:
    """Whether imagining the designs tried so far pays where bodies are chosen as `returns` does."""
    robots, arms = ("hopper", "half_cheetah"), ("returns", "returns-known", "returns-noisy")
    return Study(name="imagining-returns", environments=robots, arms=arms, seeds=AGAIN, protocol="pilot")


STUDIES = {
    study.name: study
    for study in (
        # Fig. 1 and 3, and what tells their causes apart.
        Study(
            name="paper",
            environments=("half_cheetah", "walker", "hopper"),
            tasks=("forward", "backward"),
            arms=("none", "known", "noisy", "random"),
            seeds=SEEDS,
            blocks=(
                Block(
                    environments=("hopper",),
                    arms=("control-only", "random-bodies", "oracle"),
                    seeds=SEEDS,
                ),
            ),
        ),
        Study(
            name="preview",
            environments=("hopper",),
            arms=("none", "known", "noisy", "random"),
            seeds=(0, 1, 2, 3, 4),
            protocol="preview",
            blocks=(Block(environments=("half_cheetah",), arms=("none", "known"), seeds=(0, 1, 2)),),
        ),
        bodies("bodies-develop", DEVELOP),
        bodies("bodies", CONFIRM),
        bodies_with_and_without_reach(),
        bodies_of_other_robots(),
        bodies_in_fleets(),
        imagining("imagining-develop", DEVELOP),
        imagining("imagining", CONFIRM),
        imagining_with_returns(),
        Study(
            name="smoke",
            environments=("hopper",),
            arms=("none", "known"),
            seeds=(0,),
            protocol="smoke",
        ),
    )
}
