"""How robots move, read from their files, and that nothing is simulated wrongly without a word."""

from __future__ import annotations

import re
from pathlib import Path

import gymnasium
import mujoco
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from coim.envs import HopperMorph, MorphEnv
from coim.envs.root import Root, read_root

GYMNASIUM = Path(gymnasium.__file__).parent / "envs/mujoco/assets"
HOPPER = Path(__file__).parents[2] / "coim/envs/assets/hopper.xml"


def body_of(file: str) -> type[MorphEnv]:
    class Body(HopperMorph):
        ASSET = str(GYMNASIUM / file)

        def shape_body(self, spec: object, design: object) -> None:
            pass

    return Body


@pytest.mark.parametrize(
    ("file", "root"),
    [
        ("hopper.xml", Root("planar", 1, 1, None, (2,))),
        ("walker2d.xml", Root("planar", 1, 1, None, (2,))),
        ("half_cheetah.xml", Root("planar", 1, 1, None, (2,))),
        ("ant.xml", Root("free", 2, 2, 3, ())),
        ("humanoid.xml", Root("free", 2, 2, 3, ())),
        ("inverted_pendulum.xml", Root("fixed", 0, None, None, ())),
        ("reacher.xml", Root("fixed", 0, None, None, (0,))),  # its first joint turns for ever
    ],
)
def test_gymnasiums_robots_are_planar_free_or_fixed(file: str, root: Root) -> None:
    assert read_root(mujoco.MjModel.from_xml_path(str(GYMNASIUM / file)), file) == root


def test_another_robot_is_refused_by_name_when_it_is_made() -> None:
    different = r"a slide along \[0.0, 1.0, 0.0\] .*as joint 1, not a slide along z"
    with pytest.raises(ValueError, match=f"Body has {different}.*; a planar runner has a root with a slide along x"):
        body_of("swimmer.xml")()


@pytest.mark.parametrize(
    ("drawn", "changed", "different"),
    [
        ('axis="1 0 0" pos', 'axis="-1 0 0" pos', r"a slide along \[-1.0, 0.0, 0.0\] \(rootx\) as joint 0"),
        ('axis="0 -1 0" armature', 'axis="1 0 0" armature', r"a hinge along \[1.0, 0.0, 0.0\] \(thigh\) as joint 3"),
        ('ctrllimited="true"', 'ctrllimited="false"', "a motor, thigh, without a ctrlrange"),
        ('<motor name="leg" joint="leg"/>', '<position name="leg" joint="leg"/>', "an actuator, leg, that is no motor"),
        ('geom name="floor"', 'geom name="floor" pos="0 0 1"', "no floor: no horizontal plane at z = 0"),
        ('geom name="floor"', 'geom name="floor" zaxis="1 0 0"', "no floor: no horizontal plane"),
    ],
)
def test_what_no_body_can_have_is_named(drawn: str, changed: str, different: str) -> None:
    text = HOPPER.read_text()
    assert drawn in text
    model = mujoco.MjModel.from_xml_string(text.replace(drawn, changed))
    with pytest.raises(ValueError, match=f"Hopper has {different}.*; (a planar runner|every actuator|add a geom)"):
        read_root(model, "Hopper")


FLOOR = '<geom name="floor"'
PAIR = '<contact><pair geom1="floor" geom2="foot"/></contact>'
LOOKED_AT = '<geom type="plane" size="9 9 9" contype="0" conaffinity="0"/>'


@pytest.mark.parametrize(
    ("drawn", "changed", "sentence"),
    [
        (FLOOR, f'{FLOOR} contype="0" conaffinity="0"', r"is \(0, 0\), .*\[\(1, 1\)\]; .*contype='1' conaffinity='1'"),
        (FLOOR, f'{FLOOR} contype="2" conaffinity="4"', r"floor, that no segment can touch: .* is \(2, 4\)"),
        ("<worldbody>", '<option><flag contact="disable"/></option><worldbody>', "no contacts .*; delete <flag"),
    ],
)
def test_a_floor_that_the_robot_would_fall_through_is_refused(drawn: str, changed: str, sentence: str) -> None:
    model = mujoco.MjModel.from_xml_string(HOPPER.read_text().replace(drawn, changed, 1))
    with pytest.raises(ValueError, match=f"Hopper has .*{sentence}"):
        read_root(model, "Hopper")


@pytest.mark.parametrize(
    "changed",
    [
        LOOKED_AT + FLOOR,
        f'{FLOOR} contype="0" conaffinity="1"',
        f'</worldbody>{PAIR}<worldbody>{FLOOR} contype="0" conaffinity="0"',
    ],
)
def test_a_floor_may_lie_under_one_to_look_at_and_touch_by_one_bit_or_by_a_pair(changed: str) -> None:
    text = HOPPER.read_text().replace(FLOOR, changed, 1)
    assert read_root(mujoco.MjModel.from_xml_string(text), "Hopper").kind == "planar"


def test_what_touches_the_floor_only_in_a_pair_is_a_part_of_the_robot_too(tmp_path: Path) -> None:
    text = HOPPER.read_text()
    (foot,) = re.findall(r'<geom name="foot"[^>]*>', text)
    no_bits = re.sub(r' (contype|conaffinity)="\d"', "", foot).replace(" ", ' contype="0" conaffinity="0" ', 1)
    (tmp_path / "hopper.xml").write_text(text.replace(foot, no_bits).replace("</worldbody>", f"</worldbody>{PAIR}"))
    own_class = type("Own", (HopperMorph,), {"ASSET": str(tmp_path / "hopper.xml")})
    own, bits = own_class(reset_noise=0.0), HopperMorph(reset_noise=0.0)
    taller = TensorDict({"design": torch.tensor([[1.0, 1.4, 1.2, 2.0]])}, [1])
    for env in (own, bits):
        env.reset(taller.clone())
    assert own.simulations.lowest_point(0) == pytest.approx(bits.simulations.lowest_point(0), abs=1e-9)
    state = bits.reset()["observation"]
    expected = bits.clearance(state, taller["design"])
    torch.testing.assert_close(own.clearance(state, taller["design"]), expected, rtol=0, atol=1e-6)


def test_a_floor_that_is_given_carries_a_robot_of_any_bits(tmp_path: Path) -> None:
    text = re.sub(f"{FLOOR}.*", "", HOPPER.read_text())
    file = tmp_path / "hopper.xml"
    file.write_text(text.replace('contype="1" conaffinity="1"', 'contype="2" conaffinity="4"'))
    env = body_of(str(file))(seed=0)
    env.rollout(200)
    assert env.simulations.lowest_point(0) == pytest.approx(0, abs=0.2)  # m; free fall would end 13 m below


def test_a_mesh_that_could_touch_the_floor_is_named() -> None:
    text = HOPPER.read_text().replace('geom name="leg"', 'geom name="leg" type="mesh" mesh="shin"')
    mesh = '<asset><mesh name="shin" vertex="0 0 0 1 0 0 0 1 0 0 0 -1"/></asset>'
    model = mujoco.MjModel.from_xml_string(text.replace("<worldbody>", f"{mesh}<worldbody>", 1))
    with pytest.raises(ValueError, match=r"Hopper has a segment, leg, that is a mesh .*; a planar runner"):
        read_root(model, "Hopper")


def test_a_reward_that_is_no_tensor_is_refused() -> None:
    class Paid(HopperMorph):
        @staticmethod
        def reward(*given: Tensor, task: str = "forward") -> float:  # type: ignore[override]
            return 1.0

    with pytest.raises(ValueError, match=r"the reward of Paid is a float; return a tensor \[2, 3, 1\]"):
        Paid(num_runs=3)


def test_a_body_without_motors_is_named() -> None:
    spec = mujoco.MjSpec.from_file(str(HOPPER))
    for motor in list(spec.actuators):
        spec.delete(motor)
    with pytest.raises(ValueError, match="Hopper has no motor; every actuator is a motor"):
        read_root(spec.compile(), "Hopper")


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
