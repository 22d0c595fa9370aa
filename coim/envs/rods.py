"""Parts of a robot as capsules, which drawings by lines can show: a box becomes rods beside each other."""

from __future__ import annotations

import mujoco
import numpy as np

from coim.envs.root import BOX, CAPSULE, CYLINDER, ELLIPSOID, MESH, SPHERE

DRAWN = (SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH)
FLATTEST = 7.0  # a flat part is drawn with at least a seventh of its width as its thickness
OVERLAP = 1.5  # radii between two rods beside each other, at most


def rods(kind: int, size: np.ndarray) -> np.ndarray:
    """Capsules that draw a part, in its own axes: a box, a cylinder or an ellipsoid becomes rods beside each other.

    Args:
        kind: MuJoCo's type of the part.
        size: its three numbers in m, as MuJoCo has them.

    Returns:
        Both ends and the radius in m, ``[n, 7]``, the middle one first. Edges are rounded, and what is very flat is
        drawn thicker than it is.

    Example:
        >>> rods(BOX, np.array([0.5, 0.1, 0.1])).tolist()
        [[-0.4, 0.0, 0.0, 0.4, 0.0, 0.0, 0.1]]
    """
    if kind in (SPHERE, CAPSULE):
        half = size[1] if kind == CAPSULE else 0.0
        return np.array([[0.0, 0.0, -half, 0.0, 0.0, half, size[0]]])
    sides = size[[0, 0, 1]] if kind == CYLINDER else size
    along, across, thin = np.argsort(-sides, kind="stable")
    radius = max(sides[thin], sides[across] / FLATTEST)
    reach = sides[across] - radius
    steps = int(np.ceil(reach / (OVERLAP * radius) - 1e-9))
    places = np.array([0.0, *(sign * reach * k / steps for k in range(1, steps + 1) for sign in (-1, 1))])
    is_round = kind == ELLIPSOID or (kind == CYLINDER and thin == 2)
    lengths = sides[along] * np.sqrt(1 - (places / sides[across]) ** 2) if is_round else sides[along]
    found = np.zeros((len(places), 7))
    found[:, 3 + along] = np.maximum(lengths - radius, 0)
    found[:, along] = -found[:, 3 + along]
    found[:, across] = found[:, 3 + across] = places
    found[:, 6] = radius
    return found + 0.0  # no -0


def rods_of(model: mujoco.MjModel, part: int) -> np.ndarray:
    """Return the rods of one part of a model in its own axes, ``[n, 7]``; those of a mesh draw the box around it."""
    if model.geom_type[part] != MESH:
        return rods(int(model.geom_type[part]), model.geom_size[part])
    found = rods(BOX, model.geom_aabb[part, 3:])
    found[:, :6] += np.tile(model.geom_aabb[part, :3], 2)
    return found
