"""What bodies refuse, in a sentence that names it, and that nothing moves by it."""

from __future__ import annotations

import math

import pytest
import torch
from morph_cases import BODIES
from tensordict import TensorDict

from coim.envs import HopperMorph


def test_place_refuses_what_is_no_state():
    env = HopperMorph(num_runs=2, seed=0)
    with pytest.raises(ValueError, match=r"observation must be finite and of shape \[2, 11\]"):
        env.place(torch.full((2, 11), math.nan), torch.ones(2, 4))
    with pytest.raises(ValueError, match="design"):
        env.place(torch.zeros(2, 11), torch.ones(2, 5))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"num_runs": 0}, "num_runs 0 is not a whole number of at least 1"),
        ({"num_runs": 1.5}, "num_runs 1.5 is not a whole number"),
        ({"episode_steps": -1}, "episode_steps -1 is not a whole number of at least 1"),
        ({"num_threads": 0}, "num_threads 0 is not a whole number of at least 1"),
        ({"reset_noise": -0.1}, "reset_noise -0.1 is not a finite number of at least 0"),
        ({"reset_noise": math.nan}, "reset_noise nan"),
        ({"task": "sideways"}, "unknown task 'sideways'; choose 'forward' or 'backward'"),
        ({"device": "cuda:99"}, "device 'cuda:99' does not exist here"),
    ],
)
@BODIES
def test_a_bad_argument_gets_a_sentence(body, arguments, sentence):
    with pytest.raises(ValueError, match=sentence):
        body(**arguments)


@pytest.mark.parametrize(
    ("constants", "sentence"),
    [
        ({"DESIGN_BOUNDS": (2.0, 0.5)}, r"Odd\.DESIGN_BOUNDS is \(2\.0, 0\.5\); .* low < high, with 1 between them"),
        ({"DESIGN_BOUNDS": (1.0, 1.0)}, "low < high"),
        ({"DESIGN_BOUNDS": (1.2, 2.0)}, "with 1 between them: the body as drawn, which is the first"),
        ({"DESIGN_BOUNDS": (0.5, math.nan)}, "low < high"),
        ({"FRAME_SKIP": 0}, r"Odd\.FRAME_SKIP is 0, not a whole number of at least 1"),
        ({"RESET_NOISE": -0.1}, "reset_noise -0.1 is not a finite number"),
    ],
)
def test_constants_that_no_body_can_have_are_refused(constants, sentence):
    with pytest.raises(ValueError, match=sentence):
        type("Odd", (HopperMorph,), constants)()


@pytest.mark.parametrize("names", [("a", "b", "c"), ("a", "b", "c", "c"), ("a", "b", "c", "d,e"), ("a", "b", "c", "")])
def test_names_that_do_not_fit_the_design_are_refused(names):
    class Misnamed(HopperMorph):
        DESIGN_NAMES = names

    with pytest.raises(ValueError, match=r"Misnamed.DESIGN_NAMES is .* not 4 different names .* leave it out"):
        Misnamed()


@pytest.mark.parametrize(
    ("design", "sentence"),
    [
        ([[1.0, 1.0, 1.0, 2.1]], r"leaves \[0.5, 2\]; clip it with design_spec.project"),
        ([[0.4, 1.0, 1.0, 1.0]], r"leaves \[0.5, 2\]"),
        ([[1.0, math.nan, 1.0, 1.0]], r"nan.* leaves \[0.5, 2\]"),
        ([[1.0, 1.0, 1.0]], r"design has shape \[1, 3\], this fleet takes \[1, 4\]"),
    ],
)
def test_a_bad_design_gets_a_sentence_and_the_body_stays(design, sentence):
    env = HopperMorph(seed=0)
    with pytest.raises(ValueError, match=sentence):
        env.reset(TensorDict({"design": torch.tensor(design)}, [1]))
    assert env.reset()["design"].tolist() == [[1.0] * 4]


@pytest.mark.parametrize(
    ("action", "sentence"),
    [
        (torch.zeros(3), r"action has shape \[3\], the fleet takes \[2, 3\]"),
        (torch.zeros(2, 4), r"action has shape \[2, 4\]"),
        (torch.full((2, 3), math.nan), "is not finite"),
    ],
)
def test_a_bad_action_gets_a_sentence_and_nothing_moves(action, sentence):
    env = HopperMorph(num_runs=2, seed=0)
    env.reset()
    before = env.get_simulation_state()
    with pytest.raises(ValueError, match=sentence):
        env.advance(action)
    assert (env.get_simulation_state() == before).all()


def test_a_state_of_another_fleet_size_gets_a_sentence():
    with pytest.raises(ValueError, match="the state holds 3 runs, this fleet has 2"):
        HopperMorph(num_runs=2).set_simulation_state(HopperMorph(num_runs=3).get_simulation_state())
