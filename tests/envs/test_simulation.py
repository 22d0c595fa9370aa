"""The native fleet: what breaks a simulation, who notices, and what is left in the user's folder."""

from __future__ import annotations

import threading
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch, SimulationError

from coim.envs.rods import rods
from coim.envs.root import BOX, CYLINDER, ELLIPSOID
from coim.envs.simulation import Simulations

PENDULUM = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body name="pole" pos="0 0 2">
      <joint name="hinge" axis="0 1 0"/>
      <geom name="pole" type="capsule" fromto="0 0 0 0 0 -1" size=".05" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor joint="hinge"/></actuator>
</mujoco>
"""


def lengthen(spec: mujoco.MjSpec, design: np.ndarray) -> None:
    spec.geom("pole").fromto = [0, 0, 0, 0, 0, -design[0]]


def fleet(num_threads: int = 1, num: int = 4) -> Simulations:
    designs = np.linspace(1, 2, num)[:, None]
    spec = mujoco.MjSpec.from_string(PENDULUM)
    simulations = Simulations(spec, shape_body=lengthen, designs=designs, num_threads=num_threads)
    simulations.qpos[:] = 0.5
    return simulations


def test_each_row_has_the_body_of_its_design():
    simulations = fleet()
    assert [round(float(simulations.model(k).geom("pole").size[1]), 4) for k in range(4)] == [0.5, 0.6667, 0.8333, 1.0]
    simulations.step(100)
    assert (np.diff(simulations.qpos[:, 0]) > 0).all()  # the longer, the slower to fall from 0.5 rad


def test_building_changes_only_the_rows_that_are_named():
    simulations = fleet()
    before = [simulations.model(k) for k in range(4)]
    simulations.build(np.array([2]), np.array([[1.1]]))
    assert [simulations.model(k) is before[k] for k in range(4)] == [True, True, False, True]
    assert simulations.qpos.tolist() == [[0.5]] * 4


def test_a_body_that_the_fleet_cannot_have_leaves_it_as_it_was() -> None:
    def with_a_hand(spec: mujoco.MjSpec, design: np.ndarray) -> None:
        lengthen(spec, design)
        if design[0] > 2:
            hand = spec.body("pole").add_body(name="hand", pos=[0, 0, -1])
            hand.add_joint(name="wrist", axis=[0, 1, 0])
            hand.add_geom(name="hand", size=[0.1, 0, 0])

    simulations, other = fleet(), fleet()
    simulations._shape_body = with_a_hand
    before = [simulations.model(k) for k in range(4)]
    with pytest.raises(
        ValueError,
        match=r"designs \[\[1.1\], \[2.1\]\] has other parts .*model 1 does not give mjData the batch model's layout",
    ):
        simulations.build(np.array([0, 1]), np.array([[1.1], [2.1]]))
    assert [simulations.model(k) is before[k] for k in range(4)] == [True] * 4
    for one in (simulations, other):
        assert one.step(50).size == 0
    np.testing.assert_array_equal(simulations.state, other.state)


@pytest.mark.parametrize("velocity", [np.nan, np.inf, 1e12, 2e6])
@pytest.mark.parametrize("num_threads", [1, 2])
def test_a_row_that_breaks_is_named_and_starts_again_and_no_other_row_notices(velocity, num_threads):
    sound, broken = fleet(num_threads), fleet(num_threads)
    broken.qvel[1] = velocity
    assert sound.step(5).tolist() == []
    assert broken.step(5).tolist() == [1]
    assert (broken.qpos[1, 0], broken.qvel[1, 0]) == (0, 0)
    others = [0, 2, 3]
    np.testing.assert_array_equal(broken.state[others], sound.state[others])
    assert broken.step(5).tolist() == []  # its warnings are cleared


def test_a_row_in_which_mujoco_raises_is_named_too(monkeypatch):
    simulations = fleet()

    def raising_step(self: Batch, **kwargs: object) -> None:
        raise SimulationError(np.array([2]), "stack overflow")

    monkeypatch.setattr(Batch, "step", raising_step)
    assert simulations.step(1).tolist() == [2]
    assert simulations.qpos.ravel().tolist() == [0.5, 0.5, 0.0, 0.5]


def test_a_broken_simulation_leaves_no_file_and_no_word_behind(tmp_path: Path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    simulations = fleet(num_threads=2)
    simulations.qvel[:] = np.nan
    assert simulations.step(1).size == 4
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")


def test_the_users_own_logging_is_as_it_was():
    before = mujoco.MjLogConfig.get()
    assert before.logto_file
    fleet().step(1)
    after = mujoco.MjLogConfig.get()
    assert (after.logto_file, after.logto_console) == (before.logto_file, before.logto_console)


def test_threads_that_step_together_are_silent_and_the_last_gives_the_log_back(monkeypatch):
    first_is_in, second_is_in, first_is_out = (threading.Event() for _ in range(3))
    seen = []

    def first_step(self: Batch, **kwargs: object) -> None:
        first_is_in.set()
        assert second_is_in.wait(10)

    def second_step(self: Batch, **kwargs: object) -> None:
        second_is_in.set()
        assert first_is_out.wait(10)
        seen.append(mujoco.MjLogConfig.get().logto_file)

    def step_first() -> None:
        one.step(1)
        first_is_out.set()

    one, other = fleet(num=1), fleet(num=1)
    thread = threading.Thread(target=step_first)
    monkeypatch.setattr(Batch, "step", first_step)
    thread.start()
    assert first_is_in.wait(10)
    monkeypatch.setattr(Batch, "step", second_step)
    other.step(1)
    thread.join()
    assert seen == [False]
    assert mujoco.MjLogConfig.get().logto_file


def test_capsules_are_where_the_body_is_as_it_stands():
    simulations = fleet(num=1)  # 1 m long, radius 0.05 m, hanging at 2 m
    simulations.qpos[0] = np.pi / 2  # swung up to the side of -x
    ends = simulations.capsules(0)
    np.testing.assert_allclose(ends, [[-1, 0, 2, 0, 0, 2, 0.05]], atol=1e-12)


@pytest.mark.parametrize(("kind", "size"), [(BOX, [0.2, 0.3, 0.1]), (ELLIPSOID, [0.1, 0.3, 0.2])])
def test_rods_fill_a_part_and_do_not_leave_it(kind: int, size: list[float]):
    drawn = rods(kind, np.array(size))
    reach = np.maximum(np.abs(drawn[:, :3]), np.abs(drawn[:, 3:6])) + drawn[:, 6:]
    np.testing.assert_allclose(reach.max(0), size, atol=1e-12)
    assert len(drawn) > 1


def test_a_long_cylinder_is_one_rod_and_a_disc_is_several():
    np.testing.assert_allclose(rods(CYLINDER, np.array([0.1, 0.5, 0.0])), [[0, 0, -0.4, 0, 0, 0.4, 0.1]])
    disc = rods(CYLINDER, np.array([0.5, 0.1, 0.0]))
    assert disc[0, 3:6].tolist() == pytest.approx([0.4, 0, 0])
    assert (np.hypot(disc[:, 3], disc[:, 4]) <= 0.5).all()


def test_a_mesh_is_drawn_as_the_box_around_it_and_the_world_is_not_drawn():
    corners = " ".join(f"{x} {y} {z}" for x in (2, 3) for y in (0, 0.2) for z in (0, 0.3))
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco><asset><mesh name="brick" vertex="{corners}"/></asset><worldbody>
        <geom type="box" size="1 1 .1"/><body><joint/><geom type="mesh" mesh="brick"/></body></worldbody></mujoco>"""
    )
    simulations = Simulations(spec, shape_body=lambda spec, design: None, designs=np.ones((1, 1)), num_threads=1)
    drawn = simulations.capsules(0)
    ends, radius = np.vstack([drawn[:, :3], drawn[:, 3:6]]), drawn[0, 6]
    found = [ends.min(0) - radius, ends.max(0) + radius]
    np.testing.assert_allclose(found, [[2, 0, 0], [3, 0.2, 0.3]], atol=1e-6)


def test_lifting_moves_a_body_out_of_the_floor_and_leaves_others_alone():
    spec = mujoco.MjSpec.from_string(
        """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/><body>
        <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 1" size=".1"/></body></worldbody></mujoco>"""
    )
    simulations = Simulations(spec, shape_body=lambda spec, design: None, designs=np.ones((2, 1)), num_threads=1)
    simulations.qpos[:, 1] = [0.05, 0.3]  # the round end is 0.05 m in the floor, 0.2 m above it
    for row in range(2):
        simulations.lift_out_of_floor(row)
    assert simulations.qpos[:, 1].tolist() == pytest.approx([0.1, 0.3])


def test_rows_of_one_design_share_one_body_until_one_of_them_gets_another():
    designs = np.array([[1.0], [2.0], [1.0]])
    simulations = Simulations(mujoco.MjSpec.from_string(PENDULUM), shape_body=lengthen, designs=designs, num_threads=1)
    assert simulations.model(0) is simulations.model(2)
    simulations.build(np.array([2, 0]), np.array([[1.5], [1.5]]))
    lengths = [float(simulations.model(k).geom("pole").size[1]) for k in range(3)]
    assert lengths == [0.75, 1.0, 0.75]
    simulations.build(np.array([0]), np.array([[1.2]]))
    assert float(simulations.model(2).geom("pole").size[1]) == 0.75
