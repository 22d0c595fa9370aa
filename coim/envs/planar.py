"""Check that a body fits :class:`~coim.envs.morph.MorphEnv`: a robot that runs in the plane of x and z.

The fleet reads the joints by position (root x first, then its height, then its pitch), uses the capsules to lift the
body out of a floor at z = 0, and drives motors in [-1, 1]. Any other body would silently be simulated wrongly.
"""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

SLIDE, HINGE = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
ROOT = (("slide along x", SLIDE, (1, 0, 0)), ("slide along z", SLIDE, (0, 0, 1)), ("hinge about y", HINGE, (0, 1, 0)))
RUNNER = (
    "a body is a planar runner: a root with a slide along x, a slide along z and a hinge about y, hinges about y as "
    "its joints, capsules as its segments, motors with ctrlrange -1 1 on joints, and a plane named 'floor' at z = 0"
)


def check_planar(model: mujoco.MjModel, name: str) -> None:
    """Refuse a body that is not a planar runner.

    Args:
        model: the compiled body.
        name: name of the class, for the message.

    Raises:
        ValueError: if it is not; the message says what is different, and what a body must be.
    """
    different = next(_differences(model), None)
    if different is not None:
        raise ValueError(f"{name} {different}; {RUNNER}")


def _differences(model: mujoco.MjModel) -> Iterator[str]:
    """Yield what makes a body differ from a planar runner, the most helpful difference first."""
    yield from _of_joints(model)
    for motor in range(model.nu):
        if (
            model.actuator_trntype[motor] != mujoco.mjtTrn.mjTRN_JOINT
            or model.actuator_gaintype[motor] != mujoco.mjtGain.mjGAIN_FIXED
            or model.actuator_biastype[motor] != mujoco.mjtBias.mjBIAS_NONE
            or model.actuator_dyntype[motor] != mujoco.mjtDyn.mjDYN_NONE
        ):
            yield f"has an actuator, {_named(model.actuator(motor), motor)}, that is no motor on a joint"
        limits = model.actuator_ctrlrange[motor]
        if not model.actuator_ctrllimited[motor] or limits.tolist() != [-1, 1]:
            yield f"has a motor, {_named(model.actuator(motor), motor)}, whose ctrlrange is {limits.tolist()}"
    if model.nu == 0:
        yield "has no motor"
    on_robot = model.geom_bodyid > 0
    collides = (model.geom_contype > 0) | (model.geom_conaffinity > 0)
    odd = np.flatnonzero(on_robot & collides & (model.geom_type != mujoco.mjtGeom.mjGEOM_CAPSULE))
    if odd.size:
        yield f"has a segment, {_named(model.geom(odd[0]), odd[0])}, that is no capsule"
    floor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "floor")
    if floor < 0 or model.geom_type[floor] != mujoco.mjtGeom.mjGEOM_PLANE or model.geom_pos[floor, 2] != 0:
        yield "has no plane named 'floor' at z = 0"


def _of_joints(model: mujoco.MjModel) -> Iterator[str]:
    """Yield what is different in the joints; axes are in world coordinates, in the start pose."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for place, (wanted, kind, axis) in enumerate(ROOT):
        if place >= model.njnt:
            yield f"has {model.njnt} joints"
        there = model.jnt_type[place] == kind and np.allclose(np.abs(data.xaxis[place] @ axis), 1)
        # The slides define the sign of speed and height; the pitch may have either sign.
        if not there or (kind == SLIDE and data.xaxis[place] @ axis < 0):
            yield f"has {_kind(model, data, place)} as joint {place}, not a {wanted}"
    roots = model.jnt_bodyid[: len(ROOT)]
    if (roots != roots[0]).any() or model.body_parentid[roots[0]] != 0:
        yield "has a root whose first three joints are not on one body that hangs in the world"
    for place in range(len(ROOT), model.njnt):
        if model.jnt_type[place] != HINGE or not np.allclose(np.abs(data.xaxis[place, 1]), 1):
            yield f"has {_kind(model, data, place)} as joint {place}, not a hinge about y"


def _kind(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> str:
    kind = mujoco.mjtJoint(model.jnt_type[joint]).name.removeprefix("mjJNT_").lower()
    along = f" along {np.round(data.xaxis[joint], 3).tolist()}" if kind in ("slide", "hinge") else ""
    return f"a {kind}{along} ({_named(model.joint(joint), joint)})"


def _named(part: object, number: int) -> str:
    return getattr(part, "name", "") or f"number {number}"
