"""Height of a body above the floor, as a torch function of its joints and its design.

The tables of a compiled body (offsets, anchors, sizes) are affine functions of the design if only lengths scale. They
are fitted on a few compiled bodies and checked on others. The rest is forward kinematics of heights alone: for each
body frame, the height of its origin, and the direction "up" in its own axes.

Shapes: *B any batch, Q positions, D design, J joints, G geoms.

References:
    Featherstone: Rigid body dynamics algorithms, Springer 2008, chapter 4 (kinematic trees).
    MuJoCo's documentation, chapter Computation (how several joints of one body follow each other).
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
import torch
from torch import Tensor

from coim.envs.root import BOX, CAPSULE, CYLINDER, ELLIPSOID, FREE, HINGE, SLIDE, SPHERE, colliding, find_height

UP = 2  # axis of the world that points away from the floor
EXACT = 1e-9  # m: largest allowed error of the affine function of a table
CHECKED = 16  # number of random designs, and of corners of the design space, on which the tables are checked
SHAPES = (SPHERE, CAPSULE, CYLINDER, BOX, ELLIPSOID)


class Kinematics:
    """Height of a body's lowest point, from positions and design; batched, and differentiable in both.

    Args:
        compiled: compiles the body of a design ``[D]`` float64.

    Keyword Args:
        bounds: lowest and highest design, ``[D]`` each, or numbers for all entries.
        size: D.

    Attributes:
        num_positions: Q.
        height: entry of the positions that moves the whole body up, in m.

    Raises:
        ValueError: if the body has an unknown joint or shape, no joint that moves it up and down, or lengths that are
            not affine functions of the design.

    Note:
        The height of the body at its start may be any function of the design, if either the positions measure it from
        the floor, or the clearance at the start is affine in the design. For example, the lowest of several feet starts
        at the same height for every design.
    """

    def __init__(
        self,
        compiled: Callable[[np.ndarray], mujoco.MjModel],
        *,
        bounds: tuple[Tensor, Tensor] | tuple[float, float],
        size: int,
    ) -> None:
        low, high = (np.broadcast_to(np.asarray(bound), size) for bound in bounds)
        middle, reach = (low + high) / 2, (high - low) / 4
        rng = np.random.default_rng(0)
        corners = np.where(rng.integers(0, 2, (CHECKED, size)), high, low)
        others = (rng.uniform(low, high, (CHECKED, size)), corners)
        self._designs = np.concatenate([middle[None], middle + np.diag(reach), *others])
        models = [compiled(design) for design in self._designs]
        self._read_tree(models[0])
        self._affine: dict[str, tuple[Tensor, Tensor]] = {}
        tables = [self._tables(model) for model in models]
        for name in tables[0]:
            self._affine[name] = self._fit(name, np.stack([table[name] for table in tables]))
        for name in ("body_quat", "jnt_axis", "geom_quat"):
            turns = np.stack([getattr(model, name) for model in models])
            if np.abs(turns - turns[0]).max() > EXACT:
                raise ValueError(f"{name} of this body changes with its design; only lengths may, not angles")
        self._fit_start(models)

    def lowest(self, positions: Tensor, design: Tensor) -> Tensor:
        """Height of the lowest point of the body above the floor in m, negative below it.

        Args:
            positions: MuJoCo's ``qpos``, ``[*B, Q]``.
            design: ``[*B, D]``.

        Returns:
            ``[*B, 1]``, in the wider dtype of the two; a design of whole numbers takes that of the positions.
        """
        dtype = torch.promote_types(positions.dtype, design.dtype)
        positions, design = positions.to(dtype), design.to(dtype)
        hanging = self._hanging(positions, design)
        start = self._table("start", design)
        if self._start_is_clearance:
            start = start - self._hanging(self._like(self._positions_at_start, positions), design)
        return positions[..., self.height, None] + start + hanging

    def _hanging(self, positions: Tensor, design: Tensor) -> Tensor:
        """Height of the lowest point over the root's origin, ``[*B, 1]``, whatever the height of the root."""
        body_pos, jnt_pos = self._table("body_pos", design), self._table("jnt_pos", design)
        geom_pos, geom_size = self._table("geom_pos", design), self._table("geom_size", design)
        batch = torch.broadcast_shapes(positions.shape[:-1], design.shape[:-1])
        ups = [positions.new_tensor([0.0, 0.0, 1.0]).expand(*batch, 3)]
        heights = [positions.new_zeros(batch)]
        for body in range(1, len(self._parents)):
            up, height = ups[self._parents[body]], heights[self._parents[body]]
            height = height + (up * body_pos[..., body, :]).sum(-1)
            up = up @ self._like(self._body_turn[body], positions)
            for joint in self._joints[body]:
                up, height = self._move(joint, up, height, positions, jnt_pos)
            ups.append(up)
            heights.append(height)
        lowest = [
            heights[body] + (ups[body] * geom_pos[..., i, :]).sum(-1) - self._extent(i, ups[body], geom_size[..., i, :])
            for i, body in enumerate(self._geom_body)
        ]
        return torch.stack(lowest, -1).amin(-1, keepdim=True)

    def _move(
        self, joint: int, up: Tensor, height: Tensor, positions: Tensor, jnt_pos: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Apply one joint: return "up" in the axes of its body, and the height of the body's origin."""
        at, kind = int(self._model.jnt_qposadr[joint]), int(self._model.jnt_type[joint])
        if kind == FREE:
            w, x, y, z = torch.nn.functional.normalize(positions[..., at + 3 : at + 7], dim=-1).unbind(-1)
            return torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1), height
        if at == self.height:
            return up, height
        axis = self._like(torch.from_numpy(self._model.jnt_axis[joint]), positions)
        moved = (positions[..., at] - float(self._model.qpos0[at]))[..., None]
        if kind == SLIDE:
            return up, height + (up * axis * moved).sum(-1)
        # The joint's anchor does not move. "Up" rotates opposite to the body: Rodrigues' formula with -angle.
        anchor = height + (up * jnt_pos[..., joint, :]).sum(-1)
        along = (up * axis).sum(-1, keepdim=True) * axis
        up = along + (up - along) * moved.cos() + torch.linalg.cross(up, axis.expand_as(up)) * moved.sin()
        return up, anchor - (up * jnt_pos[..., joint, :]).sum(-1)

    def _extent(self, geom: int, up: Tensor, size: Tensor) -> Tensor:
        """Return the distance from the centre of a geom down to its lowest point, ``[*B]``."""
        seen = up @ self._like(self._geom_turn[geom], up)
        kind = self._geom_type[geom]
        if kind == SPHERE:
            return size[..., 0]
        if kind == CAPSULE:
            return size[..., 0] + size[..., 1] * seen[..., 2].abs()
        if kind == CYLINDER:
            return size[..., 0] * seen[..., :2].norm(dim=-1) + size[..., 1] * seen[..., 2].abs()
        if kind == ELLIPSOID:
            return (size * seen).norm(dim=-1)
        return (size * seen.abs()).sum(-1)

    def _read_tree(self, model: mujoco.MjModel) -> None:
        """Read everything that does not depend on the design; refuse unknown joints and shapes."""
        self._model = model
        self._parents = [int(parent) for parent in model.body_parentid]
        self._joints = [range(start, start + number) for start, number in zip(model.body_jntadr, model.body_jntnum)]
        self._body_turn = _turns(model.body_quat)
        self._geoms = colliding(model)
        self._geom_body = [int(body) for body in model.geom_bodyid[self._geoms]]
        self._geom_type = [int(kind) for kind in model.geom_type[self._geoms]]
        self._geom_turn = _turns(model.geom_quat[self._geoms])
        strange = {mujoco.mjtGeom(kind).name for kind in self._geom_type if kind not in SHAPES}
        strange |= {mujoco.mjtJoint(int(kind)).name for kind in model.jnt_type if kind not in (FREE, SLIDE, HINGE)}
        if strange:
            raise ValueError(
                f"the body has {sorted(strange)}; only hinges, slides, spheres, capsules, cylinders, boxes and "
                "ellipsoids are known"
            )
        roots = [body for body, parent in enumerate(self._parents) if body and not parent]
        if len(roots) != 1:
            raise ValueError(f"the file has {len(roots)} bodies without a parent; a robot has one root")
        self.num_positions = model.nq
        height = find_height(model)
        if height is None:
            raise ValueError(
                "nothing moves this body up and down: its root has neither a free joint nor a vertical slide that no "
                "hinge of the root turns"
            )
        self._root, self.height = roots[0], height
        self._positions_at_start = torch.from_numpy(model.qpos0.copy())

    def _tables(self, model: mujoco.MjModel) -> dict[str, np.ndarray]:
        """Lengths that may depend on the design, in m, except the start of the root and the positions of slides."""
        body_pos, jnt_pos = model.body_pos.copy(), model.jnt_pos.copy()
        body_pos[self._root] = 0.0
        jnt_pos[model.jnt_type != HINGE] = 0.0
        geom_pos, geom_size = model.geom_pos[self._geoms], model.geom_size[self._geoms]
        return {"body_pos": body_pos, "jnt_pos": jnt_pos, "geom_pos": geom_pos, "geom_size": geom_size}

    def _fit_start(self, models: list[mujoco.MjModel]) -> None:
        """Fit the height of the root at position 0, or, if it is not affine, the clearance at the start."""
        starts = np.array([[model.body_pos[self._root, UP] - model.qpos0[self.height]] for model in models])
        self._affine["start"], error = _affine_fit(self._designs, starts)
        self._start_is_clearance = error > EXACT
        if self._start_is_clearance:
            designs = torch.from_numpy(self._designs)
            hanging = self._hanging(self._positions_at_start.expand(len(designs), -1), designs)
            self._affine["start"] = self._fit("clearance at the start", starts + hanging.numpy())

    def _fit(self, name: str, values: np.ndarray) -> tuple[Tensor, Tensor]:
        """Fit a table by an affine function of the design: its constant and slope."""
        fitted, error = _affine_fit(self._designs, values)
        if error > EXACT:
            raise ValueError(
                f"{name} of this body is not affine in its design (off by {error:.2g} m); override clearance()"
            )
        return fitted

    def _table(self, name: str, design: Tensor) -> Tensor:
        """Evaluate a table for each design, ``[*B, ...]``."""
        constant, slope = (self._like(part, design) for part in self._affine[name])
        return constant + torch.tensordot(design, slope, 1)

    @staticmethod
    def _like(table: Tensor, tensor: Tensor) -> Tensor:
        return table.to(tensor.device, tensor.dtype)


def _affine_fit(designs: np.ndarray, values: np.ndarray) -> tuple[tuple[Tensor, Tensor], float]:
    """Constant ``[...]`` and slope ``[D, ...]`` from the first D + 1 designs, and the largest error on all of them."""
    size = designs.shape[1]
    steps = np.diagonal(designs[1 : size + 1] - designs[0]).reshape(-1, *[1] * (values.ndim - 1))
    slope = (values[1 : size + 1] - values[0]) / steps
    constant = values[0] - np.tensordot(designs[0], slope, 1)
    error = np.abs(values - constant - np.tensordot(designs, slope, 1)).max()
    return (torch.from_numpy(constant), torch.from_numpy(slope)), float(error)


def _turns(quaternions: np.ndarray) -> Tensor:
    """Rotation matrices of quaternions, ``[n, 3, 3]``."""
    matrices = np.zeros((len(quaternions), 9))
    for matrix, quaternion in zip(matrices, quaternions):
        mujoco.mju_quat2Mat(matrix, quaternion)
    return torch.from_numpy(matrices.reshape(-1, 3, 3))
