"""How a robot moves through the world, read from its compiled body: in a plane, freely, or not at all.

The fleet reads positions by their place in ``qpos``, drives motors, and lifts robots out of a floor at z = 0. Any other
body would silently be simulated wrongly, and is refused.

Shapes: nq positions.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

FREE, SLIDE, HINGE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{name}")) for name in ("FREE", "SLIDE", "HINGE"))
PLANE, SPHERE, CAPSULE = (int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in ("PLANE", "SPHERE", "CAPSULE"))
ELLIPSOID, CYLINDER, BOX = (int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in ("ELLIPSOID", "CYLINDER", "BOX"))
MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
FLOOR = "floor"  # name of the floor of a file that has none
PLANAR = (("slide along x", SLIDE, (1, 0, 0)), ("slide along z", SLIDE, (0, 0, 1)), ("hinge about y", HINGE, (0, 1, 0)))
SEGMENTS = "spheres, capsules, cylinders, boxes and ellipsoids as its segments"
RULES = {
    "planar": "a planar runner has a root with a slide along x, a slide along z and a hinge about y, hinges about y as "
    f"its joints, and {SEGMENTS}",
    "free": "a robot that moves freely has one root with a free joint, hinges and slides as its other joints, and "
    + SEGMENTS,
    "fixed": "a robot on a fixed base has hinges and slides",
}
MOTORS = "every actuator is a motor on a joint with a range, such as <motor joint='knee' gear='100' ctrlrange='-1 1'/>"


@dataclass(frozen=True)
class Root:
    """Where the place of a robot stands in its positions.

    Attributes:
        kind: ``"planar"``: it runs in the plane of x and z; ``"free"``: a free joint carries it; ``"fixed"``: its base
            stays where it is.
        unseen: number of positions before the first observed one: where the robot is on the ground, in m.
        height: entry of the positions that moves the whole robot up, in m; None on a fixed base.
        quaternion: first of the four entries of the root's orientation (w, x, y, z); None if it has none.
        angles: entries that are wrapped to (-pi, pi]: hinges without limits, which a robot can turn for ever.
    """

    kind: Literal["planar", "free", "fixed"]
    unseen: int
    height: int | None
    quaternion: int | None
    angles: tuple[int, ...]


def read_root(model: mujoco.MjModel, name: str) -> Root:
    """Find out how a robot moves; refuse a body that :class:`~coim.envs.morph.MorphEnv` cannot simulate.

    Args:
        model: the compiled body.
        name: name of the class, for the message.

    Raises:
        ValueError: if it is none of the three kinds, has an actuator that is no motor, or moves and has no floor that
            it can touch; the message says what is different, and what a body must be.
    """
    kind = _kind_of(model)
    check = {"planar": _against_planar, "free": _against_free, "fixed": _against_fixed}[kind]
    if (different := next(check(model), None)) is not None:
        raise ValueError(f"{name} has {different}; {RULES[kind]}")
    if (different := next(_against_motors(model), None)) is not None:
        raise ValueError(f"{name} has {different}; {MOTORS}")
    if kind != "fixed":
        _check_floor(model, name)
    unlimited = (model.jnt_type == HINGE) & (model.jnt_limited == 0)
    return Root(
        kind=kind,
        unseen={"planar": 1, "free": 2, "fixed": 0}[kind],
        height=find_height(model),
        quaternion=3 if kind == "free" else None,
        angles=tuple(int(at) for at in model.jnt_qposadr[unlimited]),
    )


def find_height(model: mujoco.MjModel) -> int | None:
    """Return the entry of the positions that moves the whole robot up, or None if none does.

    A slide does so if it is vertical in the world, whatever the others do: in a root that is turned its own axis may be
    another one, and behind a hinge it turns with that.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for joint in range(model.njnt):
        at, of_root = int(model.jnt_qposadr[joint]), model.body_parentid[model.jnt_bodyid[joint]] == 0
        if not of_root or model.jnt_type[joint] not in (FREE, SLIDE):
            return None
        if model.jnt_type[joint] == FREE:
            return at + 2
        if np.allclose(data.xaxis[joint], (0, 0, 1)):
            return at
    return None


def find_floor(model: mujoco.MjModel) -> int | None:
    """Return the number of the floor, the first horizontal plane of the world at z = 0, or None if there is none."""
    found = _floors(model)
    return int(found[0]) if found.size else None


def give_floor(spec: mujoco.MjSpec) -> None:
    """Give a robot that moves a floor at z = 0 that it can touch, in place, if its file has no plane."""
    model = spec.compile()
    if find_height(model) is not None and not any(int(geom.type) == PLANE for geom in spec.worldbody.geoms):
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        contype, conaffinity = _fitting_bits(model)
        spec.worldbody.add_geom(name=FLOOR, type=plane, size=[40, 40, 40], contype=contype, conaffinity=conaffinity)


def colliding(model: mujoco.MjModel) -> np.ndarray:
    """Return the numbers of the robot's geoms that can touch something, by their bits or in a pair with the floor."""
    collides = (model.geom_contype > 0) | (model.geom_conaffinity > 0)
    pairs = np.stack([model.pair_geom1, model.pair_geom2], 1)
    collides[pairs[np.isin(pairs, _floors(model)).any(1)]] = True
    return np.flatnonzero((model.geom_bodyid > 0) & collides)


def _floors(model: mujoco.MjModel) -> np.ndarray:
    """Return the numbers of the world's horizontal planes at z = 0; a file may have one to look at and one to touch."""
    flat = np.isclose(np.abs(model.geom_quat[:, [0, 3]]).max(1), 1) & (model.geom_pos[:, 2] == 0)
    return np.flatnonzero(flat & (model.geom_type == PLANE) & (model.geom_bodyid == 0))


def _check_floor(model: mujoco.MjModel, name: str) -> None:
    """Refuse a robot without a floor, or with one that it would fall through."""
    floors = _floors(model)
    if not floors.size:
        raise ValueError(f"{name} has no floor: no horizontal plane at z = 0 in its world; add a geom of type='plane'")
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT:
        raise ValueError(f"{name} has no contacts and would fall through its floor; delete <flag contact='disable'/>")
    segments = colliding(model)
    of_floor, of_segments = (
        np.stack([model.geom_contype[geoms], model.geom_conaffinity[geoms]], 1) for geoms in (floors, segments)
    )
    # MuJoCo lets two geoms touch if the contype of one shares a bit with the conaffinity of the other, or by a <pair>.
    by_bits = (of_floor[:, None] & of_segments[:, ::-1]).any()
    pairs = np.stack([model.pair_geom1, model.pair_geom2], 1)
    by_pair = (np.isin(pairs, floors) & np.isin(pairs[:, ::-1], segments)).any()
    if not by_bits and not by_pair:
        contype, conaffinity = _fitting_bits(model)
        raise ValueError(
            f"{name} has a floor, {_named(model.geom(floors[0]), floors[0])}, that no segment can touch: its (contype, "
            f"conaffinity) is {tuple(of_floor[0].tolist())}, and those of the segments are "
            f"{sorted(set(map(tuple, of_segments.tolist())))}; give the floor contype='{contype}' "
            f"conaffinity='{conaffinity}'"
        )


def _fitting_bits(model: mujoco.MjModel) -> tuple[int, int]:
    """Return contype and conaffinity of a floor that each colliding segment of a robot can touch."""
    segments = colliding(model)
    contype, conaffinity = (
        int(np.bitwise_or.reduce(bits[segments])) for bits in (model.geom_conaffinity, model.geom_contype)
    )
    return contype, conaffinity


def _kind_of(model: mujoco.MjModel) -> Literal["planar", "free", "fixed"]:
    """Return what a body seems to be meant as; whether it is that comes later."""
    if (model.jnt_type == FREE).any():
        return "free"
    root = (model.body_parentid[model.jnt_bodyid] == 0) & (model.jnt_bodyid == model.jnt_bodyid[:1])
    return "planar" if (model.jnt_type[root] == SLIDE).sum() > 1 else "fixed"


def _against_planar(model: mujoco.MjModel) -> Iterator[str]:
    """Yield what makes a body differ from a planar runner; axes are in world coordinates, in the start pose."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for place, (wanted, kind, axis) in enumerate(PLANAR):
        if place >= model.njnt:
            yield f"{model.njnt} joints"
        there = model.jnt_type[place] == kind and np.allclose(np.abs(data.xaxis[place] @ axis), 1)
        # The slides define the sign of speed and height; the pitch may have either sign.
        if not there or (kind == SLIDE and data.xaxis[place] @ axis < 0):
            yield f"{_described(model, data, place)} as joint {place}, not a {wanted}"
    roots = model.jnt_bodyid[: len(PLANAR)]
    if (roots != roots[0]).any() or model.body_parentid[roots[0]] != 0:
        yield "a root whose first three joints are not on one body that hangs in the world"
    for place in range(len(PLANAR), model.njnt):
        if model.jnt_type[place] != HINGE or not np.allclose(np.abs(data.xaxis[place, 1]), 1):
            yield f"{_described(model, data, place)} as joint {place}, not a hinge about y"
    yield from _against_shapes(model)


def _against_free(model: mujoco.MjModel) -> Iterator[str]:
    """Yield what makes a body differ from a robot that moves freely."""
    if model.jnt_type[0] != FREE or (model.jnt_type == FREE).sum() != 1 or (model.body_parentid[1:] == 0).sum() != 1:
        yield "more than one body that moves by itself, or a free joint that is not the first one"
    yield from _against_joints(model, start=1)
    yield from _against_shapes(model)


def _against_fixed(model: mujoco.MjModel) -> Iterator[str]:
    """Yield what makes a body differ from a robot on a fixed base."""
    if model.njnt == 0:
        yield "no joint"
    yield from _against_joints(model, start=0)


def _against_joints(model: mujoco.MjModel, *, start: int) -> Iterator[str]:
    """Yield joints that are neither hinge nor slide."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for place in range(start, model.njnt):
        if model.jnt_type[place] not in (HINGE, SLIDE):
            yield f"{_described(model, data, place)} as joint {place}, not a hinge or a slide"


def _against_shapes(model: mujoco.MjModel) -> Iterator[str]:
    """Yield segments whose lowest point is not known."""
    if not colliding(model).size:
        yield "no segment that can touch the floor"
    for geom in colliding(model):
        if model.geom_type[geom] not in (SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX):
            shape = mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
            yield (
                f"a segment, {_named(model.geom(geom), geom)}, that is a {shape} (with contype='0' conaffinity='0' it "
                "would only be looked at)"
            )


def _against_motors(model: mujoco.MjModel) -> Iterator[str]:
    """Yield actuators that are no motors on joints with limits, or that there is none."""
    for motor in range(model.nu):
        if (
            model.actuator_trntype[motor] != mujoco.mjtTrn.mjTRN_JOINT
            or model.actuator_gaintype[motor] != mujoco.mjtGain.mjGAIN_FIXED
            or model.actuator_biastype[motor] != mujoco.mjtBias.mjBIAS_NONE
            or model.actuator_dyntype[motor] != mujoco.mjtDyn.mjDYN_NONE
        ):
            yield f"an actuator, {_named(model.actuator(motor), motor)}, that is no motor on a joint"
        low, high = model.actuator_ctrlrange[motor]
        if not model.actuator_ctrllimited[motor] or not low < high:
            yield f"a motor, {_named(model.actuator(motor), motor)}, without a ctrlrange"
    if model.nu == 0:
        yield "no motor"


def _described(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> str:
    kind = mujoco.mjtJoint(model.jnt_type[joint]).name.removeprefix("mjJNT_").lower()
    along = f" along {np.round(data.xaxis[joint], 3).tolist()}" if kind in ("slide", "hinge") else ""
    return f"a {kind}{along} ({_named(model.joint(joint), joint)})"


def _named(part: object, number: int) -> str:
    return getattr(part, "name", "") or f"number {number}"
