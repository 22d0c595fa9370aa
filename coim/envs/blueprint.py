"""A body as other programs need it: its file, its lengths, what it observes and how it acts.

Shapes: S observation, A action.
"""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
from torch import Tensor

from coim.envs.morph import MorphEnv

LONG = (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER)
AXES = ("x", "y", "z")


def mjcf(robot: MorphEnv, design: Tensor) -> str:
    """The robot of a design ``[D]`` as an MJCF file, which MuJoCo compiles to the same model."""
    spec = robot.simulations.body(design.numpy())
    spec.compile()
    return str(spec.to_xml())


def lengths(robot: MorphEnv) -> list[dict[str, str | float]]:
    """A row for each geom of the robot: its body and shape, its length and radius in m, and its mass in kg.

    The length of a capsule or a cylinder is that of its axis, without the round ends. Other shapes have the lengths of
    their three half-axes instead, as MuJoCo has them.
    """
    model = robot.simulations.model(0)
    rows: list[dict[str, str | float]] = []
    for geom in np.flatnonzero(model.geom_bodyid > 0):
        kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), model.geom_size[geom]
        body = model.body(model.geom_bodyid[geom])
        shape = kind.name.removeprefix("mjGEOM_").lower()
        row: dict[str, str | float] = {"geom": model.geom(geom).name, "body": body.name, "shape": shape}
        if kind in LONG:
            row |= {"length_m": float(2 * size[1]), "radius_m": float(size[0])}
        else:
            row["half_axes_m"] = " ".join(f"{half:g}" for half in size)
        rows.append(row | {"body_mass_kg": float(body.mass[0])})
    return rows


def observed(robot: MorphEnv) -> list[tuple[str, str]]:
    """Name and unit of each entry of the observation, ``[S]``: positions of the joints, then their velocities.

    What the policy does not see, such as the place on the ground, is left out at the front.
    """
    model = robot.simulations.model(0)
    positions, velocities = [], []
    for joint in range(model.njnt):
        where, speed = _entries(_called(model, joint), mujoco.mjtJoint(int(model.jnt_type[joint])))
        positions += where
        velocities += speed
    unseen = model.nq + model.nv - robot.observation_spec["observation"].shape[-1]
    named = [*positions, *velocities][unseen:]
    for angle in robot.angle_indices:
        named[angle] = (f"{named[angle][0]}, wrapped to (-pi, pi]", named[angle][1])
    return named


def _called(model: mujoco.MjModel, joint: int) -> str:
    """The name of a joint, or of what it moves, where the file has none."""
    return model.joint(joint).name or model.body(model.jnt_bodyid[joint]).name or f"joint {joint}"


def _entries(name: str, kind: mujoco.mjtJoint) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """The positions and the velocities of a joint, each with its unit."""
    if kind == mujoco.mjtJoint.mjJNT_SLIDE:
        return [(f"position of {name}", "m")], [(f"velocity of {name}", "m/s")]
    if kind == mujoco.mjtJoint.mjJNT_HINGE:
        return [(f"angle of {name}", "rad")], [(f"angular velocity of {name}", "rad/s")]
    turn = [(f"{entry} of the quaternion of {name}", "1") for entry in ("w", *AXES)]
    spin = [(f"angular velocity of {name} about {axis}", "rad/s") for axis in AXES]
    if kind == mujoco.mjtJoint.mjJNT_BALL:
        return turn, spin
    place = [(f"{axis} of {name}", "m") for axis in AXES]
    return [*place, *turn], [*((f"velocity of {name} along {axis}", "m/s") for axis in AXES), *spin]


def motors(robot: MorphEnv) -> Iterator[tuple[str, float, float, str]]:
    """Joint of each motor, its torque at the actions -1 and 1, and the unit: N on a slide, else N m."""
    model = robot.simulations.model(0)
    for motor in range(model.nu):
        joint = model.actuator_trnid[motor, 0]
        low, high = (float(end) for end in model.actuator_ctrlrange[motor] * model.actuator_gear[motor, 0])
        slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        yield _called(model, joint), low, high, "N" if slides else "N m"
