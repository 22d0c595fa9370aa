"""Segments whose lengths a design scales, and what hangs on them.

A design's entry names capsules of the file. They are stretched about the joint of their body: a place x of the body
goes to ``p + xi (x - p)``, where p is the anchor of the body's first hinge, or the origin of a body without one. This
moves the ends of the capsules that are named, the middles of the body's other geoms and its sites, and the joints by
which other bodies hang on it. Radii, angles, joint ranges and motors stay; densities too, so that mass follows length.
A robot that moves starts as high above the floor as the drawn one, with all joints within their ranges.

Shapes: D design.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from math import isnan, pi

import mujoco
import numpy as np

from coim.envs.root import CAPSULE, HINGE, find_height
from coim.envs.simulation import start_clearance

Scale = Mapping[str, Sequence[str]]
CONNECT, WELD = mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD
SAME_MASS = 1e-9  # largest relative error of a body's mass after its densities were made constant


@dataclass(frozen=True)
class _Stretched:
    """One body that an entry of the design stretches; parts are numbers in the lists of the file.

    Attributes:
        entry: number of the entry.
        anchor: the place that stays, in the body's frame, m.
        scaled: geoms whose length scales.
        carried: other geoms and sites, with their middles, m.
        hanging: bodies that hang on it, with the way from their origin to their joint, m.
    """

    entry: int
    anchor: np.ndarray
    scaled: tuple[int, ...]
    carried: tuple[tuple[str, int, np.ndarray], ...]
    hanging: tuple[tuple[int, np.ndarray], ...]


class Segments:
    """Scale the lengths of a robot that is drawn in a file.

    Args:
        drawn: the robot at xi = 1, after :func:`keep_densities`. It is not changed.
        scale: for each entry of a design, the names of the capsules that it stretches.

    Raises:
        ValueError: if a name is no capsule of the robot or is named twice, a body has capsules of two entries, or its
            mass, its place or what it is connected to is given in a way that a length cannot change.
    """

    def __init__(self, drawn: mujoco.MjSpec, scale: Scale) -> None:
        self._entries = _entries_of_geoms(drawn, scale)
        model = drawn.compile()
        self._bodies = list(self._plan(drawn, model, scale))
        _check_loops(drawn, {geom.parent.id for geom in drawn.geoms if geom.name in self._entries})
        self._clearance = None if find_height(model) is None else start_clearance(model)

    def stretch(self, spec: mujoco.MjSpec, design: np.ndarray) -> None:
        """Scale the lengths of a copy of the drawn robot in place; its root stays where it is.

        Args:
            spec: a copy of the drawn robot.
            design: ``[D]`` float64.
        """
        bodies, geoms, sites = spec.bodies, spec.geoms, spec.sites
        for plan in self._bodies:
            xi, anchor = design[plan.entry], plan.anchor
            for number in plan.scaled:
                geom = geoms[number]
                if isnan(geom.fromto[0]):
                    geom.pos = anchor + (geom.pos - anchor) * xi
                    geom.size = [geom.size[0], geom.size[1] * xi, 0.0]
                else:
                    ends = geom.fromto.reshape(2, 3)
                    geom.fromto = (anchor + (ends - anchor) * xi).ravel()
            for kind, number, middle in plan.carried:
                part, moved = (geoms if kind == "geom" else sites)[number], (middle - anchor) * (xi - 1)
                if isnan(part.fromto[0]):
                    part.pos = part.pos + moved
                else:
                    part.fromto = part.fromto + np.tile(moved, 2)
            for number, to_joint in plan.hanging:
                child = bodies[number]
                child.pos = anchor + (child.pos + to_joint - anchor) * xi - to_joint

    def shape(self, spec: mujoco.MjSpec, design: np.ndarray) -> None:
        """Scale the lengths as :meth:`stretch` does, and start as high above the floor as the drawn robot."""
        self.stretch(spec, design)
        if self._clearance is None:
            return
        rise = self._clearance - start_clearance(spec.compile())
        root = next(body for body in spec.bodies if body.parent is not None and body.parent.name == "world")
        root.pos = root.pos + np.array([0.0, 0.0, rise])
        for joint in root.joints:  # a height that is counted from the floor goes on being so
            if joint.type == mujoco.mjtJoint.mjJNT_SLIDE and joint.ref != 0:
                joint.ref = joint.ref + rise

    def _plan(self, drawn: mujoco.MjSpec, model: mujoco.MjModel, scale: Scale) -> Iterator[_Stretched]:
        """Find out what the entries move, body by body."""
        geoms, sites, bodies = drawn.geoms, drawn.sites, drawn.bodies
        names = list(scale)
        for body in bodies:
            own = [i for i, geom in enumerate(geoms) if geom.parent.id == body.id]
            entries = sorted({self._entries[geoms[i].name] for i in own if geoms[i].name in self._entries})
            if not entries:
                continue
            if len(entries) > 1:
                raise ValueError(
                    f"body {body.name!r} has capsules of two entries, {names[entries[0]]!r} and {names[entries[1]]!r}; "
                    "name them in one entry, or put some into a body of their own, without a joint"
                )
            _check_body(drawn, body, [*(geoms[i] for i in own), *body.bodies, *body.sites])
            scaled = tuple(i for i in own if geoms[i].name in self._entries)
            carried = [("geom", i, model.geom_pos[geoms[i].id].copy()) for i in own if i not in scaled]
            carried += [
                ("site", i, model.site_pos[site.id].copy()) for i, site in enumerate(sites) if site.parent.id == body.id
            ]
            hanging = [i for i, child in enumerate(bodies) if i and child.parent.id == body.id]
            yield _Stretched(
                entry=entries[0],
                anchor=_anchor(model, body.id),
                scaled=scaled,
                carried=tuple(carried),
                hanging=tuple((i, _turned(model, bodies[i].id) @ _anchor(model, bodies[i].id)) for i in hanging),
            )


def keep_densities(spec: mujoco.MjSpec) -> None:
    """Give the robot densities in place of masses, in place, so that longer segments are heavier.

    Otherwise a segment would keep the ``mass`` of its geom, and with ``settotalmass`` the robot its own.

    Raises:
        ValueError: if a body would have another mass than in its file.
    """
    wanted = spec.compiler.settotalmass
    spec.compiler.settotalmass = -1
    model = spec.compile()
    ratio = wanted / model.body_mass.sum() if wanted > 0 else 1.0
    for geom in spec.geoms:
        if not isnan(geom.mass) and int(geom.type) == CAPSULE:
            radius, half = model.geom_size[geom.id, :2]
            if geom.typeinertia == mujoco.mjtGeomInertia.mjINERTIA_SHELL:
                geom.density = geom.mass / (4 * pi * radius * (half + radius))  # kg/m2
            else:
                geom.density = geom.mass / (pi * radius**2 * (2 * half + 4 / 3 * radius))
            geom.mass = np.nan
        geom.density, geom.mass = geom.density * ratio, geom.mass * ratio
    masses, kept = model.body_mass * ratio, spec.compile().body_mass
    changed = np.flatnonzero(np.abs(kept - masses) > SAME_MASS * masses)
    if changed.size:
        body = int(changed[0])
        raise ValueError(
            f"body {model.body(body).name!r} weighs {masses[body]:g} kg in its file, and {kept[body]:g} kg once "
            "masses are densities; no length can change an <inertial>, nor how settotalmass scales it: give densities "
            "in place of both"
        )


def _entries_of_geoms(drawn: mujoco.MjSpec, scale: Scale) -> dict[str, int]:
    """Return the number of the entry that stretches each geom, by its name."""
    geoms = {geom.name: geom for geom in drawn.geoms if geom.name}
    capsules = [name for name, geom in geoms.items() if int(geom.type) == CAPSULE]
    found: dict[str, int] = {}
    for entry, (words, names) in enumerate(scale.items()):
        if isinstance(names, str) or not names:
            raise ValueError(f"scale[{words!r}] is {names!r}, not a list of capsules such as {capsules[:1]}")
        for name in names:
            if name not in geoms:
                raise ValueError(f"scale[{words!r}] names {name!r}, which is no geom of the file; it has {capsules}")
            if int(geoms[name].type) != CAPSULE:
                shape = geoms[name].type.name.removeprefix("mjGEOM_").lower()
                raise ValueError(
                    f"scale[{words!r}] names {name!r}, a {shape}, which has no length; draw it as a capsule with "
                    f"fromto, or choose of {capsules}"
                )
            if name in found:
                raise ValueError(f"scale[{words!r}] names {name!r}, which is named twice; name it once")
            if geoms[name].parent.name == "world":
                raise ValueError(f"scale[{words!r}] names {name!r}, which is part of the world; put it into a body")
            found[name] = entry
    return found


def _check_body(drawn: mujoco.MjSpec, body: mujoco.MjsBody, parts: Sequence[object]) -> None:
    """Refuse a body whose mass is given, or whose parts have their places in frames of their own."""
    if body.explicitinertial and drawn.compiler.inertiafromgeom != mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        raise ValueError(
            f"body {body.name!r} has an <inertial>, which no length can change; delete it and give its geoms densities"
        )
    if any(getattr(part, "frame", None) is not None for part in parts):
        raise ValueError(
            f"a part of body {body.name!r} lies in a <frame>; write its place without one, as mujoco.MjSpec.to_xml() "
            "does after compile()"
        )


def _check_loops(drawn: mujoco.MjSpec, scaled: Set[int]) -> None:
    """Refuse a closed chain through a scaled body that has an anchor instead of sites: it would not move."""
    for equality in drawn.equalities:
        if equality.type not in (CONNECT, WELD) or equality.objtype != mujoco.mjtObj.mjOBJ_BODY:
            continue
        one, other = (_ancestry(drawn, name or "world") for name in (equality.name1, equality.name2))
        joint = next(body for body in one if body in other)
        # From one end to the other: what lies further in moves both ends alike.
        through = [body for body in (*one[: one.index(joint)], *other[: other.index(joint)], joint) if body in scaled]
        if through:
            word = "connect" if equality.type == CONNECT else "weld"
            raise ValueError(
                f"<{word} body1={equality.name1!r} body2={equality.name2!r}> closes a chain through body "
                f"{drawn.bodies[through[0]].name!r}, which a design scales, and its anchor would stay; put a site on "
                "each of the two bodies, which moves with its length, and give site1 and site2 in place of the bodies"
            )


def _ancestry(drawn: mujoco.MjSpec, name: str) -> list[int]:
    """Return the numbers of a body and of the bodies that it hangs on, up to the world."""
    body, found = drawn.body(name), []
    while body is not None:
        found.append(body.id)
        body = body.parent
    return found


def _anchor(model: mujoco.MjModel, body: int) -> np.ndarray:
    """Return the place of a body that its stretching leaves alone: its first hinge, or its origin; ``[3]`` m."""
    joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
    return next((model.jnt_pos[joint].copy() for joint in joints if model.jnt_type[joint] == HINGE), np.zeros(3))


def _turned(model: mujoco.MjModel, body: int) -> np.ndarray:
    """Return how a body is turned in its parent, ``[3, 3]``."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, model.body_quat[body])
    return matrix.reshape(3, 3)
