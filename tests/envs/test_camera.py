"""Pictures, where there is something to draw with; a sentence, where there is not."""

from __future__ import annotations

import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest
from two_link_arm import TWO_LINK_ARM

from coim.envs import AntMorph, HopperMorph
from coim.envs.camera import drawn_axes, dress, make_room
from coim.envs.root import give_floor

BOX = """
<mujoco><worldbody><body pos="0 0 .5">
  <freejoint/><geom type="box" size=".4 .2 .1"/>
</body></worldbody></mujoco>
"""

PICTURES = """
import numpy as np, torch
from tensordict import TensorDict
from coim.envs import GymnasiumEnv, HopperMorph
env = HopperMorph(num_runs=2, seed=0)
env.reset(TensorDict({"design": torch.tensor([[0.5] * 4, [2.0] * 4])}, [2]))
try:
    small, tall = env.render(0, width=160, height=120), env.render(1, width=160, height=120)
except RuntimeError as error:
    print("MISSING", error)
else:
    assert small.shape == tall.shape == (120, 160, 3) and small.dtype == np.uint8
    orange = [((p[..., 0] > 1.2 * p[..., 2]).any(1).nonzero()[0]) for p in (small, tall)]
    print("ROWS", *(len(rows) for rows in orange))
    qpos = env.simulations.qpos[0].copy()
    with env.camera(0, width=160, height=120) as camera:
        places = (0.0, 0.5, 200.0, 1.99, 2.01)
        pictures = [camera.photograph(qpos + [x, *[0] * (len(qpos) - 1)]).astype(int) for x in places]
        assert camera._model.vis.quality.shadowsize == 512  # 4096 would double what a picture takes
    here, half, far, before, after = pictures
    assert (here == small).all()
    gym = GymnasiumEnv("HopperMorph", design=[0.5] * 4, reset_noise=0.0, render_mode="rgb_array", width=160, height=120)
    gym.reset()
    short = gym.render()
    gym.reset(options={"design": [2.0] * 4})
    grown = gym.render()
    gym.close()
    assert short.shape == (120, 160, 3) and short.dtype == np.uint8
    assert (short != grown).any()
    assert (grown == gym.bodies.render(width=160, height=120)).all()
    print("CHANGE", *(int(np.abs(a - b).sum()) for a, b in ((here, half), (here, far), (before, after))))
"""


def run(code: str, **environment: str) -> str:
    clean = {
        key: value for key, value in os.environ.items() if key not in ("MUJOCO_GL", "DISPLAY", "PYOPENGL_PLATFORM")
    }
    out = subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "-c", code],
        env=clean | environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return out.stdout


def test_a_picture_shows_the_body_of_the_row_or_says_what_is_missing():
    said = run(PICTURES).split()  # no screen and no MUJOCO_GL
    if said[0] == "MISSING":
        assert "MUJOCO_GL=egl" in said
    else:
        small, tall = int(said[1]), int(said[2])
        assert 2 * small < tall  # rows of the picture that the robot fills
        half_a_metre, two_hundred, two_centimetres = (int(change) for change in said[4:])
        assert two_hundred < half_a_metre / 20  # far away there is floor and light as at the start
        assert two_centimetres < half_a_metre / 4  # and on the way there the floor never jumps


def test_without_opengl_one_sentence_says_what_to_set_and_to_install():
    said = run(PICTURES, MUJOCO_GL="glfw")  # which needs a screen
    assert said.startswith("MISSING no picture without OpenGL")
    assert "MUJOCO_GL=egl" in said
    assert "libegl1 libegl-mesa0" in said


def test_a_missing_library_is_said_in_one_sentence_at_import():
    """Where OSMesa is installed there is nothing to say."""
    environment = {**os.environ, "MUJOCO_GL": "osmesa"}
    out = subprocess.run([sys.executable, "-c", "import coim"], env=environment, capture_output=True, text=True)
    sentence = "ImportError: MUJOCO_GL=osmesa names an OpenGL library that is missing"
    assert out.returncode == 0 or out.stderr.splitlines()[-1].startswith(sentence)


def test_what_is_drawn_by_lines_is_seen_from_the_side_or_a_little_from_above_and_behind() -> None:
    assert drawn_axes(HopperMorph(seed=0).root).tolist() == [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    axes = drawn_axes(AntMorph(seed=0).root)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.cross(axes[0], axes[1]), axes[2], atol=1e-12)  # lengths and sides are not mirrored
    assert axes[0, 0] > 0.9  # its way goes to the right
    assert axes[2, 0] < 0 < axes[2, 2]


def test_a_picture_has_room_for_the_robot_and_the_ground_under_it_not_for_the_floor_far_away() -> None:
    spec = mujoco.MjSpec.from_string(BOX)
    give_floor(spec)
    make_room(spec, spec.compile())
    assert spec.stat.extent == pytest.approx(1.2 * 0.8)  # a box 0.8 m long, and a tenth on each side
    assert spec.stat.center.tolist() == pytest.approx([0, 0, 0.3])  # its top is at 0.6 m


def test_a_picture_has_room_for_an_arm_on_every_side_of_its_base() -> None:
    spec = mujoco.MjSpec.from_string(TWO_LINK_ARM)
    model = spec.compile()
    make_room(spec, model)
    data = mujoco.MjData(model)
    for angle in (0.0, 0.5 * np.pi, np.pi):
        data.qpos[0] = angle
        mujoco.mj_kinematics(model, data)
        tips = data.geom_xpos - spec.stat.center
        assert (np.abs(tips) + model.geom_size[:, 1:2] < spec.stat.extent / 2).all()


def test_all_designs_are_drawn_to_the_scale_of_the_file_or_of_the_longest_body() -> None:
    env = HopperMorph(seed=0)
    assert [env.drawn_body(np.full(4, factor)).stat.extent for factor in (0.5, 2.0)] == [2.8, 2.8]
    own = [mujoco.MjSpec.from_string(BOX) for _ in range(2)]
    own[1].geoms[0].size = [0.8, 0.2, 0.1]
    longest = own[1].compile()
    for spec in own:
        make_room(spec, longest)
    assert own[0].stat.extent == own[1].stat.extent == pytest.approx(1.2 * 1.6)


def test_a_file_without_a_light_gets_one_and_another_keeps_its_own() -> None:
    assert dress(mujoco.MjSpec.from_string(BOX), 64, 48).compile().nlight == 1
    hopper = HopperMorph(seed=0).simulations.body(np.ones(4))
    assert dress(hopper, 64, 48).compile().light_diffuse.tolist() == hopper.compile().light_diffuse.tolist()
