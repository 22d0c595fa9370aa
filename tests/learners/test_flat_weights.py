"""What both learners share: a flat buffer of weights, and a state that other networks refuse."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from copy import deepcopy
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from toy_env import ToyEnv
from toy_learners import dynamics_learner, sac_learner

from coim import GaussianEnsemble
from coim.learners import FlatLearner
from coim.learners.flat_weights import read_networks

Rows = Callable[..., TensorDict]
Make = Callable[..., FlatLearner]
EACH = [sac_learner, dynamics_learner]


def numbers(state: dict[str, Any]) -> list[Tensor]:
    """Copies of all tensors of a state, and of the states within it."""
    nested = (numbers(value) if isinstance(value, dict) else [value] for value in state.values())
    return [value.clone() for values in nested for value in values if isinstance(value, Tensor)]


def learnt(make: Make, make_rows: Rows, *runs: int, **sizes: Any) -> FlatLearner:
    """A learner after two updates."""
    learner = make(*runs, **sizes)
    learner.update(make_rows(2, 8, *runs))  # type: ignore[attr-defined]
    return learner


ALIKE = {
    # As many numbers in policy and critics, in other layers.
    "hidden units": (sac_learner, {"num_cells": (4, 4, 6)}, {"num_cells": (7, 1, 8)}, r"policy.layers.0.weight is .*4"),
    "layers": (sac_learner, {"num_cells": (1, 8, 5)}, {"num_cells": (4, 7)}, "policy.layers.0.weight is "),
    "hidden units of a model": (
        dynamics_learner,
        {"num_cells": (1, 6)},
        {"num_cells": (4,)},
        r"ensemble.layers.0.weight is \(3, 7, 1\) in the state and \(3, 7, 4\) in this learner",
    ),
    "members as runs": (
        dynamics_learner,
        {"num_runs": 2, "num_members": 3},
        {"num_runs": 3, "num_members": 2},
        r"ensemble.layers.0.weight is \(2, 3, 7, 16\) in the state and \(3, 2, 7, 16\) in this learner; make it with",
    ),
}


@pytest.mark.parametrize(("make", "theirs", "own", "sentence"), ALIKE.values(), ids=ALIKE)
def test_a_state_with_as_many_numbers_in_other_shapes_is_refused(
    make_rows: Rows, make: Make, theirs: dict[str, Any], own: dict[str, Any], sentence: str
) -> None:
    state, learner = make(**theirs).state_dict(), make(**own)
    assert state["weights"].shape == learner.state_dict()["weights"].shape
    before = numbers(learner.state_dict())
    with pytest.raises(ValueError, match=sentence):
        learner.load_state_dict(state)
    assert all(map(torch.equal, numbers(learner.state_dict()), before))


@pytest.mark.parametrize(
    ("theirs", "own", "sentence"),
    [
        ((16,), (16, 16), "policy.layers.2.weight is missing in the state and (16, 4) in this learner"),
        ((16, 16), (16,), "policy.layers.2.weight is (16, 4) in the state and missing in this learner"),
    ],
)
def test_a_layer_that_only_one_has_is_named(theirs: tuple[int, ...], own: tuple[int, ...], sentence: str) -> None:
    """The shapes of all other layers agree."""
    shapes = {layers: sac_learner(num_cells=layers).state_dict()["shapes"] for layers in (theirs, own)}
    state = shapes[theirs] | {name: shape for name, shape in shapes[own].items() if name in shapes[theirs]}
    with pytest.raises(ValueError, match=re.escape(sentence)):
        sac_learner(num_cells=own).load_state_dict({"shapes": state})


@pytest.mark.parametrize("make", EACH)
@pytest.mark.parametrize("num_runs", [None, 3])
def test_a_state_from_before_shapes_were_saved_still_loads(make_rows: Rows, make: Make, num_runs: int | None) -> None:
    runs = () if num_runs is None else (num_runs,)
    expected, other = learnt(make, make_rows, *runs), make(num_runs, seed=1)
    state = deepcopy(expected.state_dict())
    assert list(state.pop("shapes"))[-1].endswith(".bias")
    other.load_state_dict(state)
    for learner in (expected, other):
        learner.update(make_rows(2, 8, *runs, seed=1))  # type: ignore[attr-defined]
    assert all(map(torch.equal, numbers(other.state_dict()), numbers(expected.state_dict())))


@pytest.mark.parametrize("make", EACH)
def test_a_state_without_shapes_is_compared_by_its_size(make: Make) -> None:
    state = {name: value for name, value in make(num_cells=(8,)).state_dict().items() if name != "shapes"}
    held, own = (len(make(num_cells=cells).state_dict()["weights"]) for cells in ((8,), (16,)))
    with pytest.raises(
        ValueError, match=f"the state holds {held} weights, this learner has {own}; make it with the hi"
    ):
        make(num_cells=(16,)).load_state_dict(state)


@pytest.mark.parametrize("make", EACH)
def test_the_shapes_are_those_of_the_weights_in_their_order(make: Make) -> None:
    learner = make(2, num_cells=(4, 5))
    shapes = list(learner.state_dict()["shapes"].values())
    assert next(iter(learner.state_dict()["shapes"])) in ("policy.layers.0.weight", "ensemble.layers.0.weight")
    assert shapes == [tuple(weights.shape) for weights in learner.weights_by_run()][: len(shapes)]
    assert sum(map(math.prod, shapes)) == len(learner.state_dict()["weights"])


@pytest.mark.parametrize("make", EACH)
def test_a_single_run_and_a_fleet_of_one_are_two_things(make: Make) -> None:
    with pytest.raises(ValueError, match=r"layers.0.weight is .* in the state and \(1, .* in this learner"):
        make(1).load_state_dict(make(None).state_dict())


@pytest.mark.parametrize("make", EACH)
@pytest.mark.parametrize("num_runs", [None, 3])
def test_weights_and_moments_by_run_are_views(make_rows: Rows, make: Make, num_runs: int | None) -> None:
    learner = learnt(make, make_rows, *(() if num_runs is None else (num_runs,)))
    for found in (learner.weights_by_run(), learner.moments_by_run()):
        assert {len(tensor) for tensor in found} == {num_runs or 1}
        for tensor in found:
            tensor[0] = 7.0
    state = learner.state_dict()
    for flat in (state["weights"], state["moments"]["exp_avg"], state["moments"]["exp_avg_sq"]):
        assert int((flat == 7.0).sum()) == len(flat) / (num_runs or 1)


def test_an_optimiser_that_has_seen_nothing_has_no_moments() -> None:
    assert sac_learner().moments_by_run() == []


def test_networks_are_read_out_of_a_state(make_rows: Rows) -> None:
    learner = learnt(dynamics_learner, make_rows)
    ensemble = GaussianEnsemble.for_env(ToyEnv(), num_cells=(16, 16)).double()
    read_networks({"ensemble": ensemble.network}, learner.state_dict())
    own = learner.ensemble.network  # type: ignore[attr-defined]
    assert all(map(torch.equal, ensemble.network.parameters(), own.parameters()))
    other = GaussianEnsemble.for_env(ToyEnv(), num_cells=(1, 6)).double().network
    before = [parameter.clone() for parameter in other.parameters()]
    with pytest.raises(ValueError, match=r"ensemble.layers.0.weight is \(3, 7, 4\) in the state and \(3, 7, 1\)"):
        read_networks({"ensemble": other}, dynamics_learner(num_cells=(4,)).state_dict())
    assert all(map(torch.equal, other.parameters(), before))


@pytest.mark.parametrize("make", EACH)
def test_an_unknown_precision_is_refused(make: Make) -> None:
    with pytest.raises(ValueError, match="precision='float16' is unknown; choose 'float32' or 'bfloat16'"):
        make(precision="float16")
