"""Which bodies may be a MorphEnv: planar runners, and nothing that would be simulated wrongly without a word."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import mujoco
import pytest
import torch
from torch import Tensor

from coim.envs import HopperMorph, MorphEnv
from coim.envs.planar import check_planar

GYMNASIUM = Path(gymnasium.__file__).parent / "envs/mujoco/assets"
HOPPER = Path(__file__).parents[2] / "coim/envs/assets/hopper.xml"


def body_of(file: str) -> type[MorphEnv]:
    class Body(HopperMorph):
        ASSET = str(GYMNASIUM / file)

        def shape_body(self, spec: object, design: object) -> None:
            pass

    return Body


@pytest.mark.parametrize(
    ("file", "different"),
    [
        ("inverted_pendulum.xml", "has a hinge along .* as joint 1, not a slide along z"),
        ("swimmer.xml", r"has a slide along \[0.0, 1.0, 0.0\] .*as joint 1, not a slide along z"),
        ("ant.xml", r"has a free \(root\) as joint 0, not a slide along x"),
        ("humanoid.xml", r"has a free \(root\) as joint 0"),
        ("reacher.xml", "has a hinge along .* as joint 0"),
    ],
)
def test_another_robot_is_refused_by_name_when_it_is_made(file: str, different: str) -> None:
    with pytest.raises(ValueError, match=f"Body {different}.*a body is a planar runner: a root with a slide along x"):
        body_of(file)()


@pytest.mark.parametrize("file", ["hopper.xml", "walker2d.xml", "half_cheetah.xml"])
def test_gymnasiums_own_planar_runners_are_taken(file: str) -> None:
    check_planar(mujoco.MjModel.from_xml_path(str(GYMNASIUM / file)), file)


@pytest.mark.parametrize(
    ("drawn", "changed", "different"),
    [
        ('axis="1 0 0" pos', 'axis="-1 0 0" pos', r"a slide along \[-1.0, 0.0, 0.0\] \(rootx\) as joint 0"),
        ('axis="0 -1 0" armature', 'axis="1 0 0" armature', r"a hinge along \[1.0, 0.0, 0.0\] \(thigh\) as joint 3"),
        ('ctrlrange="-1 1"', 'ctrlrange="-2 2"', r"a motor, thigh, whose ctrlrange is \[-2.0, 2.0\]"),
        ('ctrllimited="true"', 'ctrllimited="false"', "a motor, thigh, whose ctrlrange"),
        ('<motor name="leg" joint="leg"/>', '<position name="leg" joint="leg"/>', "an actuator, leg, that is no motor"),
        ('geom name="leg"', 'geom name="leg" type="box"', "a segment, leg, that is no capsule"),
        ('geom name="floor"', 'geom name="floor" pos="0 0 1"', "no plane named 'floor' at z = 0"),
        ('geom name="floor"', 'geom name="ground"', "no plane named 'floor'"),
    ],
)
def test_what_is_not_a_planar_runner_is_named(drawn: str, changed: str, different: str) -> None:
    text = HOPPER.read_text()
    assert drawn in text
    model = mujoco.MjModel.from_xml_string(text.replace(drawn, changed).replace('size=".04 .25"', 'size=".04 .25 .04"'))
    with pytest.raises(ValueError, match=f"Hopper has {different}.*; a body is a planar runner"):
        check_planar(model, "Hopper")


def test_a_body_without_motors_is_named() -> None:
    spec = mujoco.MjSpec.from_file(str(HOPPER))
    for motor in list(spec.actuators):
        spec.delete(motor)
    with pytest.raises(ValueError, match="Hopper has no motor; a body is"):
        check_planar(spec.compile(), "Hopper")


@pytest.mark.parametrize(
    ("reward", "found"),
    [
        (lambda next_observation: next_observation[..., 5], r"shape \[2, 3\] and dtype torch.float32"),
        (lambda next_observation: next_observation, r"shape \[2, 3, 11\]"),
        (lambda next_observation: next_observation[..., :1].mean(0), r"shape \[3, 1\]"),
        (lambda next_observation: next_observation[..., :1].double(), r"shape \[2, 3, 1\] and dtype torch.float64"),
        (lambda next_observation: next_observation[..., :1] > 0, r"shape \[2, 3, 1\] and dtype torch.bool"),
    ],
)
def test_a_reward_of_another_shape_or_dtype_is_refused_when_the_body_is_made(reward: object, found: str) -> None:
    class Paid(HopperMorph):
        @staticmethod
        def reward(
            observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor, task: str = "forward"
        ) -> Tensor:
            return reward(next_observation)

    with pytest.raises(ValueError, match=rf"the reward of Paid has {found}.*not \[2, 3, 1\].*keep the last axis"):
        Paid(num_runs=3)


@pytest.mark.parametrize("scale", [(1.0,) * 10, (1.0,) * 13, (*[1.0] * 10, 0.0), (*[1.0] * 10, float("nan"))])
def test_a_scale_that_does_not_fit_the_observation_is_refused(scale: tuple[float, ...]) -> None:
    class Scaled(HopperMorph):
        OBSERVATION_SCALE = scale

    with pytest.raises(ValueError, match=r"Scaled.OBSERVATION_SCALE is .* not 11 positive numbers"):
        Scaled()


def test_a_scale_may_have_one_entry_for_the_root_that_is_left_out() -> None:
    class Scaled(HopperMorph):
        OBSERVATION_SCALE = (9.0, *HopperMorph.OBSERVATION_SCALE)

    assert torch.equal(Scaled().observation_scale, HopperMorph().observation_scale)
