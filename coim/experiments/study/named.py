"""The studies that have a name."""

from __future__ import annotations

from coim.experiments.study.definition import Block, Study

SEEDS = tuple(range(10))

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
        Study(
            name="smoke",
            environments=("hopper",),
            arms=("none", "known"),
            seeds=(0,),
            protocol="smoke",
        ),
    )
}
