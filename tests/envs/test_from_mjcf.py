"""Bodies made from a file and a list of what scales."""

from __future__ import annotations

import pickle
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from physics_checks import GYMNASIUM_ASSETS
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import check_env_specs

from coim import morph_from_mjcf
from coim.envs import HalfCheetahMorph, HopperMorph, MorphEnv
from coim.envs.segments import Segments, keep_densities

HOPPER = Path(__file__).parents[2] / "coim/envs/assets/hopper.xml"
EXACT = ("body_pos", "body_quat", "body_ipos", "body_mass", "body_inertia", "body_subtreemass", "dof_M0", "qpos0")
EXACT += ("geom_pos", "geom_quat", "geom_size", "geom_rbound", "jnt_pos", "jnt_axis", "jnt_range", "jnt_stiffness")
EXACT += ("dof_damping", "dof_armature", "dof_invweight0", "body_invweight0", "actuator_gear", "qpos_spring")
ARM = """
<mujoco model="two-link arm"><option timestep=".01"/>
  <worldbody>
    <camera name="above" pos="0 0 2"/>
    <body name="upper">
      <joint name="shoulder" axis="0 0 1" damping=".1"/>
      <geom name="upper" type="capsule" fromto="0 0 0 .5 0 0" size=".03" mass="2"/>
      <geom name="lamp" type="sphere" pos=".25 0 .1" size=".02"/>
      <site name="bulb" pos=".25 0 .2"/>
      <body name="lower" pos=".6 .1 0" euler="0 0 90">
        <joint name="elbow" axis="0 0 1" pos="-.1 .1 0" range="-150 150" damping=".1"/>
        <geom name="lower" type="capsule" fromto="-.1 .1 0 .3 .1 0" size=".03"/>
      </body>
    </body>
    <body name="target" pos="0 .5 0"><geom name="target" type="sphere" size=".01" contype="0" conaffinity="0"/></body>
  </worldbody>
  <actuator><motor joint="shoulder" ctrlrange="-2 2"/><motor joint="elbow" ctrlrange="-2 2"/></actuator>
</mujoco>
"""


def slow(observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor) -> Tensor:
    return -next_observation[..., -2:].square().mean(-1, keepdim=True)


def along(
    observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor, task: str = "forward"
) -> Tensor:
    return next_observation[..., :1] * (1 if task == "forward" else -1)


@pytest.fixture(scope="module")
def arm_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(ARM)
    return path


@pytest.fixture(scope="module")
def arm(arm_file: Path) -> type[MorphEnv]:
    scale = {"upper arm": ["upper"], "lower arm": ["lower"]}
    return morph_from_mjcf(arm_file, scale, slow, bounds={"upper arm": (0.5, 2.0), "lower arm": (0.8, 1.5)})


@pytest.mark.parametrize("file", [HOPPER.parent / "half_cheetah.xml", GYMNASIUM_ASSETS / "half_cheetah.xml"])
def test_half_cheetah_from_its_file_is_the_same_body_for_any_design(file: Path) -> None:
    """Gymnasium's own file gives the mass of the whole; it becomes a density, as in ours."""
    cheetah = HalfCheetahMorph()
    drawn = mujoco.MjSpec.from_file(str(file))
    keep_densities(drawn)
    segments = Segments(drawn, HalfCheetahMorph.SCALE)
    for design in np.random.default_rng(0).uniform(0.8, 2.0, (8, 6)):
        spec = drawn.copy()
        segments.shape(spec, design)
        made, own = spec.compile(), cheetah.simulations.body(design).compile()
        differences = {name: np.abs(getattr(made, name) - getattr(own, name)).max() for name in EXACT}
        assert max(differences.values()) < 1e-12, differences


def test_a_hopper_from_its_file_moves_as_the_hopper() -> None:
    """Its frames lie elsewhere: those of the hopper's own class are in the middle of its shank."""
    scale = {"torso": ["torso"], "thigh": ["thigh"], "shank": ["leg"], "foot": ["foot"]}
    made = morph_from_mjcf(HOPPER, scale, HopperMorph.reward, frame_skip=4)(num_runs=3, reset_noise=0.0)
    own = HopperMorph(num_runs=3, reset_noise=0.0)
    designs = torch.tensor(HopperMorph.FIRST_DESIGNS[:3])
    starts = [env.reset(TensorDict({"design": designs}, [3])) for env in (made, own)]
    torch.testing.assert_close(starts[0]["observation"], starts[1]["observation"])
    actions = 2 * torch.rand(10, 3, 3, generator=torch.Generator().manual_seed(0)) - 1
    for action in actions:
        (here, reward, _), (there, own_reward, _) = made.advance(action), own.advance(action)
    torch.testing.assert_close(here, there, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(reward, own_reward)
    torch.testing.assert_close(made.clearance(here, designs), own.clearance(there, designs), atol=1e-5, rtol=1e-5)


def test_what_hangs_on_a_segment_moves_with_it_and_density_stays(arm: type[MorphEnv]) -> None:
    model = arm().simulations.body(np.array([2.0, 1.5])).compile()
    assert model.geom("upper").size[1] == pytest.approx(0.5)  # half of 1 m
    assert model.geom("lamp").pos.tolist() == pytest.approx([0.5, 0, 0.2])  # it stays a lamp of 2 cm
    assert model.geom("lamp").size[0] == pytest.approx(0.02)
    assert model.site("bulb").pos.tolist() == pytest.approx([0.5, 0, 0.4])
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.joint("elbow").xanchor.tolist() == pytest.approx([1.0, 0, 0])  # it was at the end, 0.5 m
    assert model.geom("lower").size[1] == pytest.approx(1.5 * 0.2)
    ends = data.geom("lower").xpos - data.joint("elbow").xanchor
    assert np.linalg.norm(ends) == pytest.approx(1.5 * 0.2)  # the middle, about the elbow
    volumes = [2 * half + 4 / 3 * 0.03 for half in (0.25, 0.5)]
    lamp = 1000 * 4 / 3 * np.pi * 0.02**3
    assert model.body("upper").mass[0] - lamp == pytest.approx(2 * volumes[1] / volumes[0])  # drawn with 2 kg


def test_a_part_that_is_given_by_its_ends_moves_along_and_keeps_its_length(arm_file: Path, tmp_path: Path) -> None:
    path, bulb = tmp_path / "rod.xml", '<site name="bulb" pos=".25 0 .2"/>'
    rod = '<geom name="rod" type="capsule" fromto=".25 0 .2 .25 .1 .2" size=".02"/>'
    path.write_text(arm_file.read_text().replace(bulb, rod))
    made = morph_from_mjcf(path, {"upper arm": ["upper"]}, slow)
    longer = made().simulations.body(np.array([2.0])).compile()
    assert longer.geom("rod").pos.tolist() == pytest.approx([0.5, 0.1, 0.4])
    assert longer.geom("rod").size[1] == pytest.approx(0.05)


def test_a_shell_of_a_given_mass_weighs_as_in_its_file_and_grows_with_its_surface() -> None:
    drawn = mujoco.MjSpec.from_string(ARM.replace('mass="2"', 'mass="3" shellinertia="true"'))
    lamp = 1000 * 4 / 3 * np.pi * 0.02**3
    keep_densities(drawn)
    assert drawn.compile().body("upper").mass[0] - lamp == pytest.approx(3)
    Segments(drawn, {"upper arm": ["upper"]}).stretch(drawn, np.array([2.0]))
    assert drawn.compile().body("upper").mass[0] - lamp == pytest.approx(3 * (0.5 + 0.03) / (0.25 + 0.03))


def test_an_arm_passes_torchrls_checks_and_has_names_bounds_and_first_designs(arm: type[MorphEnv]) -> None:
    assert (arm.__name__, arm.__module__) == ("TwoLinkArm", __name__)
    env = arm(num_runs=2, seed=0)
    check_env_specs(env)
    assert arm.design_names() == ("upper arm", "lower arm")
    assert env.design_spec.space.high.tolist() == [2.0, 1.5]
    firsts = torch.tensor(arm.FIRST_DESIGNS)
    assert firsts[0].tolist() == [1.0, 1.0]
    assert (firsts.shape, env.design_spec.expand(5, 2).is_in(firsts)) == ((5, 2), True)
    assert arm.OBSERVATION_SCALE != (1.0,) * 4
    with pytest.raises(
        ValueError, match="the reward of TwoLinkArm knows no task 'backward'; give it a fifth parameter"
    ):
        arm(task="backward")


Arm: type[MorphEnv]


def test_a_class_at_the_top_of_a_module_can_be_pickled(arm_file: Path) -> None:
    global Arm
    Arm = morph_from_mjcf(arm_file, {"upper": ["upper"]}, slow, name="Arm")
    env = Arm(seed=0)
    again = pickle.loads(pickle.dumps(env))
    action = torch.ones(1, 2)
    for got, wanted in zip(again.advance(action), env.advance(action)):
        assert got.equal(wanted)
    assert pickle.loads(pickle.dumps(env.reward_fn)).func is Arm.reward


def test_a_reward_that_takes_a_task_is_told_it(arm_file: Path) -> None:
    body = morph_from_mjcf(arm_file, {"upper": ["upper"]}, along)
    row = (torch.ones(1, 4), torch.ones(1, 2), torch.ones(1, 4), torch.ones(1, 1))
    assert [body(task=task).reward_fn(*row).item() for task in ("forward", "backward")] == [1, -1]


@pytest.mark.parametrize(
    ("scale", "sentence"),
    [
        ({}, "scale is empty; name what a design scales"),
        ({"a": ["left"]}, r"scale\['a'\] names 'left', which is no geom of the file; it has \['upper', 'lower'\]"),
        ({"a": ["lamp"]}, r"names 'lamp', a sphere, which has no length; draw it as a capsule .* \['upper', 'lower'\]"),
        ({"a": "upper"}, r"scale\['a'\] is 'upper', not a list of capsules such as \['upper'\]"),
        ({"a": []}, r"scale\['a'\] is \(\), not a list"),
        ({"a": ["upper"], "b": ["upper"]}, r"scale\['b'\] names 'upper', which is named twice"),
        ({"a,b": ["upper"]}, "not 1 different names of letters"),
    ],
)
def test_a_scale_that_names_no_lengths_gets_a_sentence(arm_file: Path, scale: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        morph_from_mjcf(arm_file, scale, slow)


@pytest.mark.parametrize(
    ("drawn", "changed", "sentence"),
    [
        ('type="sphere" pos=".25 0 .1"', 'type="capsule" fromto="0 0 0 0 0 .1"', "body 'upper' has capsules of two"),
        (
            '<joint name="shoulder"',
            '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><joint name="shoulder"',
            "inertial",
        ),
        (
            '<option timestep=".01"/>',
            '<option timestep=".01"/><compiler settotalmass="9"/><worldbody><body name="box">'
            '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody>',
            "body 'box' weighs .* kg in its file, and 1 kg once .*settotalmass",
        ),
        ('<site name="bulb"', '<frame pos="0 0 1"><site name="b2"/></frame><site name="bulb"', "lies in a <frame>"),
        (
            '<motor joint="elbow" ctrlrange="-2 2"/>',
            '<position joint="elbow"/>',
            "actuator, number 1, that is no motor",
        ),
        ('ctrlrange="-2 2"/></actuator>', "/></actuator>", "a motor, number 1, without a ctrlrange; every actuator is"),
    ],
)
def test_a_file_that_cannot_be_scaled_gets_a_sentence(tmp_path: Path, drawn: str, changed: str, sentence: str) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(ARM.replace(drawn, changed))
    scale = {"upper": ["upper"], "lamp": ["lamp"]} if "fromto" in changed else {"upper": ["upper"]}
    with pytest.raises(ValueError, match=sentence):
        morph_from_mjcf(path, scale, slow)


@pytest.mark.parametrize(
    ("chain", "scaled"),
    [
        ('<connect body1="upper" anchor=".5 0 0"/>', "upper"),
        ('<weld body1="lower"/>', "upper"),  # lower hangs on it
        ('<connect body1="upper" body2="lower" anchor=".6 .1 0"/>', "lower"),
    ],
)
def test_a_closed_chain_whose_anchor_would_stay_is_refused(tmp_path: Path, chain: str, scaled: str) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(ARM.replace("<actuator>", f"<equality>{chain}</equality><actuator>"))
    with pytest.raises(ValueError, match=f"through body '{scaled}', which a design scales, .*; .* site1 and site2"):
        morph_from_mjcf(path, {"arm": [scaled]}, slow)


def test_a_closed_chain_by_sites_moves_with_the_length_and_one_beside_it_stays() -> None:
    sites = '<connect site1="bulb" site2="pin"/><connect body1="upper" anchor=".5 0 0"/>'
    text = ARM.replace("<actuator>", f"<equality>{sites}</equality><actuator>")
    text = text.replace('<geom name="lower"', '<site name="pin" pos=".1 .1 0"/><geom name="lower"')
    drawn = mujoco.MjSpec.from_string(text)
    Segments(drawn, {"lower arm": ["lower"]}).stretch(drawn, np.array([2.0]))
    model = drawn.compile()
    assert model.site("pin").pos.tolist() == pytest.approx([0.3, 0.1, 0])  # from 0.2 m to 0.4 m behind the elbow
    assert model.eq_data[1, :3].tolist() == [0.5, 0, 0]


def test_a_file_that_is_not_there_and_bounds_that_leave_an_entry_out_are_refused(arm_file: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"there is no file .*nowhere.xml; give the path"):
        morph_from_mjcf("nowhere.xml", {"upper": ["upper"]}, slow)
    with pytest.raises(ValueError, match=r"bounds are those of \['lower'\], and a design has \['upper'\]; give a pair"):
        morph_from_mjcf(arm_file, {"upper": ["upper"]}, slow, bounds={"lower": (0.5, 2.0)})
    with pytest.raises(ValueError, match=r"BOUNDS is \(\(2, 0.5\),\); .* each low < high, with 1 between them"):
        morph_from_mjcf(arm_file, {"upper": ["upper"]}, slow, bounds=(2, 0.5))
    camera = morph_from_mjcf(arm_file, {"upper": ["upper"]}, slow, camera="below")
    with pytest.raises(ValueError, match=r"CAMERA is 'below', and the file has the cameras \['above'\]"):
        camera().camera()
