"""What a study consists of, and what cannot be one."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from small_study import study

from coim import EpisodeDone, HopperMorph
from coim.envs import BODIES
from coim.experiments.run.build import build
from coim.experiments.run.settings import METHODS, Settings
from coim.experiments.study.arms import ARMS
from coim.experiments.study.definition import PROTOCOLS, Block, from_json
from coim.experiments.study.named import STUDIES


def test_every_combination_is_a_cell_and_one_seed_of_all_arms_comes_before_the_next() -> None:
    more = Block(environments=("walker",), arms=("none",), seeds=(7, 8, 9), tasks=("backward",))
    assert [cell.name for cell in study(blocks=(more,)).cells()] == [
        "hopper-forward-none-3",
        "hopper-forward-known-3",
        "walker-backward-none-7",
        "hopper-forward-none-4",
        "hopper-forward-known-4",
        "walker-backward-none-8",
        "walker-backward-none-9",
    ]


def test_arms_of_a_seed_differ_in_nothing_but_the_arm() -> None:
    cells = study(arms=tuple(ARMS), seeds=(5,), overrides={"lr": 0.1}).cells()
    assert len(cells) == len(ARMS)
    common = {name: getattr(Settings(), name) for arm in ARMS.values() for name in arm.settings}
    assert len({dataclasses.replace(cell.settings, **common) for cell in cells}) == 1
    assert len({cell.settings for cell in cells}) == len(ARMS)
    assert {cell.settings.lr for cell in cells} == {0.1}
    assert {cell.settings.seed for cell in cells} == {5}


def test_arms_of_a_seed_compute_the_same_until_something_is_imagined_for_them() -> None:
    """On the first body no individual network has met the population's: whatever differs there is a stream that moved.

    The random bodies are the same later on too.
    """
    first, random = {}, {}
    for cell in study(arms=tuple(ARMS), seeds=(5,), overrides={"first_episodes": 2, "num_designs": 7}).cells():
        episodes = [event for event in build(BODIES["hopper"], cell.settings) if isinstance(event, EpisodeDone)]
        first[cell.arm] = [
            (float(e.training_return), float(e.evaluation_return), float(e.metrics["individual/loss_qvalue"]))
            for e in episodes
            if e.index == 0
        ]
        random[cell.arm] = [e.design.tolist() for e in episodes if e.kind == "random"][:1]
    assert len(first["none"]) == 2
    assert all(numbers == first["none"] for numbers in first.values())
    assert random.pop("control-only") == []
    assert all(bodies == random["none"] for bodies in random.values())


def test_seeds_can_share_a_cell_along_the_run_axis() -> None:
    cells = study(arms=("none",), seeds=(0, 1, 2, 3, 4), seeds_per_cell=2).cells()
    assert [(cell.settings.seed, cell.settings.num_runs) for cell in cells] == [(0, 2), (2, 2), (4, 1)]


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"environments": ("snake",)}, "'snake' is no environment; there are half_cheetah, hopper, walker, ant"),
        ({"arms": ("oracel",)}, "arm 'oracel' is none of none, known"),
        ({"tasks": ("up",)}, "tasks has 'up', each must be 'forward' or 'backward'"),
        ({"protocol": "papre"}, "protocol is 'papre', it must be 'paper', 'preview', 'pilot' or 'smoke'"),
        ({"overrides": {"learning_rate": 1}}, "overrides of learning_rate are not possible"),
        ({"overrides": {"seed": 1}}, "overrides of seed are not possible"),
        ({"overrides": {"num_cells": 4}}, "num_cells is 4, it must be a list"),
        ({"overrides": {"lr": -1}}, "lr is -1, it must be above 0"),
        ({"seeds": (1, 1)}, "seeds has 1 more than once; name each of them once"),
        ({"seeds": (0, 1, 1, 2), "seeds_per_cell": 2}, "seeds has 1 more than once"),
        ({"arms": ("none", "none")}, "arms has 'none' more than once"),
        ({"seeds": ()}, "seeds is empty"),
        ({"blocks": ({"arms": ("none",)},)}, "blocks has {.*}, each must be a Block"),
        ({"seeds_per_cell": 0}, "seeds_per_cell is 0, it must be at least 1"),
    ],
)
def test_what_cannot_be_is_named_before_anything_is_computed(fields: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        study(**fields)


def test_an_override_that_changes_nothing_where_it_is_written_is_refused() -> None:
    climbing = {"search": "gradient", "num_particles": 9}
    with pytest.raises(ValueError, match="in the overrides num_particles has no effect with search gradient"):
        study(overrides=climbing)
    with pytest.raises(ValueError, match="sigma has no effect with imagine none; leave it out"):
        study(arms=("none", "oracle"), overrides={"sigma": 0.2})
    assert study(arms=("none", "noisy"), overrides={"sigma": 0.2}).overrides  # it has one in some of the cells
    more = Block(environments=("walker",), arms=("none",), seeds=(9,), overrides={"model_lr": 0.1})
    with pytest.raises(ValueError, match="model_lr has no effect with imagine none"):
        study(arms=("known",), blocks=(more,))


def test_an_override_that_some_arms_would_not_hear_is_refused() -> None:
    """It would change what the others are, under their names, or nothing at all."""
    cases = {
        ("grounded",): {"reach": 0.5},
        ("none", "returns"): {"chosen_by": "posterior"},
        ("grounded", "grounded-governed-both"): {"individual_imagined_share": 0.1},
    }
    for arms, overrides in cases.items():
        (name,) = overrides
        with pytest.raises(ValueError, match=f"the override of {name} does not reach {arms[-1]}, as these arms set it"):
            study(arms=arms, overrides=overrides)
    same = study(arms=("none", "known"), overrides={"chosen_by": "returns"})
    assert {cell.settings.chosen_by for cell in same.cells()} == {"returns"}
    more = Block(environments=("walker",), arms=("grounded",), seeds=(9,))
    with pytest.raises(ValueError, match="the override of reach does not reach grounded"):
        study(arms=("none",), overrides={"reach": 0.5}, blocks=(more,))


@pytest.mark.parametrize(("seeds", "twice"), [((3,), "none-3"), ((4, 3), "none-3, hopper-forward-none-4")])
def test_a_seed_that_two_blocks_share_is_named_with_its_place(seeds: tuple[int, ...], twice: str) -> None:
    """Also where it is not the first of its cell, which alone names the cell's folder."""
    more = Block(environments=("hopper",), arms=("none",), seeds=seeds)
    with pytest.raises(ValueError, match=f"^hopper-forward-{twice} would be made twice; take it out of all but one b"):
        study(blocks=(more,), seeds_per_cell=2)


def test_a_first_design_is_held_against_each_body() -> None:
    one = study(overrides={"first_design": (1, 1, 1, 2)})
    assert one.cells()[0].settings.first_design == (1, 1, 1, 2)
    assert all(isinstance(factor, float) for factor in one.cells()[0].settings.first_design)
    with pytest.raises(ValueError, match=r"1.0, 2.5\), a design of hopper has 4 scale factors from 0.5 to 2.0; write"):
        study(overrides={"first_design": (1, 1, 1, 2.5)})
    with pytest.raises(ValueError, match="a design of walker has 7 scale factors"):
        study(environments=("hopper", "walker"), overrides={"first_design": (1, 1, 1, 2)})
    together = {"seeds": (0, 1), "seeds_per_cell": 2}
    two = study(**together, overrides={"first_design": (1, 1, 1, 2, 0.6, 1, 1, 1)})
    algorithm = build(HopperMorph, two.cells()[0].settings)
    assert algorithm.design_choice.first_designs.tolist() == [[[1, 1, 1, 2], [pytest.approx(0.6), 1, 1, 1]]]
    with pytest.raises(ValueError, match=r"first_design is .* from 0\.5 to 2"):
        study(**together, overrides={"first_design": (1, 1, 1, 2, 2.5, 1, 1, 1)})


def test_the_preview_has_the_papers_networks_batches_and_updates() -> None:
    preview, paper = PROTOCOLS["preview"], PROTOCOLS["paper"]
    cheaper = {"num_designs", "first_episodes", "episodes", "search"}
    assert dataclasses.replace(paper, **{name: getattr(preview, name) for name in cheaper}) == preview
    assert preview.num_designs >= 5 + 8
    assert len(STUDIES["preview"].cells()) == 4 * 5 + 2 * 3


def test_a_method_is_confirmed_by_the_study_it_was_developed_on_with_other_seeds() -> None:
    for name in ("bodies", "imagining"):
        develop, confirm = STUDIES[f"{name}-develop"], STUDIES[name]
        own = [
            {(cell.environment, cell.arm, dataclasses.replace(cell.settings, name="", seed=0)) for cell in made.cells()}
            for made in (develop, confirm)
        ]
        assert own[0] == own[1]
        assert not {*develop.seeds} & {*confirm.seeds}
    counts = [len(STUDIES[name].cells()) for name in ("bodies-develop", "bodies", "imagining-develop", "imagining")]
    assert counts == [7 * 5, 7 * 10, (8 + 3) * 5, (8 + 3) * 10]


@pytest.mark.parametrize(
    ("method", "imagined"), [("grounded", ("known", "noisy", "random")), ("returns", ("known", "noisy"))]
)
def test_an_arm_that_imagines_with_other_bodies_differs_from_its_namesake_in_the_choice_alone(
    method: str, imagined: tuple[str, ...]
) -> None:
    for imagine in imagined:
        assert ARMS[f"{method}-{imagine}"].settings == ARMS[imagine].settings | METHODS[method]


def test_the_study_of_the_readme_is_one(tmp_path: Path) -> None:
    readme = (Path(__file__).parents[3] / "README.md").read_text()
    (tmp_path / "mine.json").write_text(readme.split("```json\n")[1].split("```")[0])
    cells = from_json(tmp_path / "mine.json").cells()
    assert [cell.arm for cell in cells] == ["none", "oracle"] * 3
    assert {cell.settings.episodes for cell in cells} == {20}
