"""A fleet of MuJoCo simulations, each with its own body, stepped by native threads.

Shapes: K simulations, D design, nq positions, nv velocities, nu motors.

This module uses only numpy and MuJoCo. It alone decides how a body is built, and when a simulation is broken.

References:
    Todorov, Erez, Tassa: MuJoCo: A physics engine for model-based control, IROS 2012.
"""

from __future__ import annotations

import ctypes
import functools
import threading
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from coim.envs.rods import DRAWN, rods_of
from coim.envs.root import BOX, CAPSULE, CYLINDER, ELLIPSOID, FREE, SPHERE, colliding, find_height

BEYOND_PHYSICS = 1e6  # m, rad, m/s, rad/s: far beyond any working body; MuJoCo itself warns only from 1e10 on


class _BatchConfig(ctypes.Structure):
    """MuJoCo's ``mjBatchConfig``."""

    _fields_ = [("nthread", ctypes.c_int), ("persistent", ctypes.c_ubyte)]


class _Silence:
    """Inside, MuJoCo writes no log.

    The log is the process's. Of threads that are inside together, the first switches it off, the last gives it back.
    """

    def __init__(self) -> None:
        self._lock, self._inside = threading.Lock(), 0
        self._chosen_by_user = mujoco.MjLogConfig.get()

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                self._chosen_by_user, off = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
                off.logto_file = off.logto_console = False
                off.set()
            self._inside += 1

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                self._chosen_by_user.set()


_SILENCE = _Silence()


class Simulations:
    """K simulations of bodies with different lengths.

    Args:
        drawn: the body of the XML file, xi = 1.

    Keyword Args:
        shape_body: changes the body at xi = 1 into the body of a design ``[D]``, in place.
        designs: the first designs, ``[K, D]``.
        num_threads: native threads that share the simulations; they do not change the results.

    Attributes:
        qpos: joint positions, ``[K, nq]`` float64. All arrays here are live: the next step starts from the values that
            are written to them.
        qvel: joint velocities, ``[K, nv]``.
        ctrl: motor commands, ``[K, nu]``.
        state: everything that a simulation keeps from step to step, ``[K, n]``; a copy of a row copies a simulation.
    """

    def __init__(
        self,
        drawn: mujoco.MjSpec,
        *,
        shape_body: Callable[[mujoco.MjSpec, np.ndarray], None],
        designs: np.ndarray,
        num_threads: int,
    ) -> None:
        self._drawn, self._shape_body = drawn, shape_body
        self._models = self._compiled(designs)
        self._batch = Batch(self._models[0], len(designs), num_threads)
        self._batch.set_models(self._models)
        self._num_threads = num_threads
        self.state: np.ndarray = self._batch.state
        self.qpos, self.qvel, self.ctrl = (self._batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
        self._warnings = self._batch.warning[:, :, 1]  # number of warnings of each kind, [K, kinds]
        # Time, positions and velocities are the first columns of the state.
        moving = mujoco.mjtState.mjSTATE_TIME | mujoco.mjtState.mjSTATE_QPOS | mujoco.mjtState.mjSTATE_QVEL
        self._moving = self.state[:, : mujoco.mj_stateSize(self._models[0], int(moving))]
        self._scratch = mujoco.MjData(self._models[0])
        self._height = find_height(self._models[0])

    def body(self, design: np.ndarray) -> mujoco.MjSpec:
        """Return the body of a design ``[D]``, to compile (a third of a millisecond) or to draw."""
        spec = self._drawn.copy()
        self._shape_body(spec, np.asarray(design, dtype=np.float64))
        return spec

    def model(self, row: int) -> mujoco.MjModel:
        """Return the compiled body of one simulation. Do not change it: simulations of one design may share it."""
        return self._models[row]

    def build(self, rows: np.ndarray, designs: np.ndarray) -> None:
        """Give some simulations new bodies, ``designs [len(rows), D]``. Their states do not change.

        Each body is compiled from scratch, so that everything that depends on lengths (masses, inertias, bounding
        volumes, start pose) is right. To change fields of a compiled model is faster, but one forgotten field makes
        others wrong.

        Raises:
            ValueError: if a body has other parts than those of the fleet, which stays as it was.
        """
        models = list(self._models)
        for row, model in zip(rows, self._compiled(designs)):
            models[row] = model
        try:
            self._batch.set_models(models)
        except mujoco.FatalError as error:
            raise ValueError(
                f"a body of designs {designs.tolist()} has other parts than those of the fleet ({error}); "
                "shape_body may move and resize parts, and add or remove none"
            ) from error
        self._models = models

    def _compiled(self, designs: np.ndarray) -> list[mujoco.MjModel]:
        """Compile the bodies of the designs, once for all rows with the same design."""
        distinct = {design.tobytes(): design for design in designs}
        models = {key: self.body(design).compile() for key, design in distinct.items()}
        return [models[design.tobytes()] for design in designs]

    def start(self, rows: np.ndarray) -> None:
        """Put some simulations into the start pose of their bodies, at rest, without any state from before."""
        self._batch.reset(rows, stage=mujoco.mjtStage.mjSTAGE_NONE.value)

    def step(self, num_steps: int) -> np.ndarray:
        """Advance all simulations under their ``ctrl``.

        A simulation breaks if MuJoCo warns or raises, or if one of its numbers is not finite or beyond 1e6 (m, rad,
        m/s, rad/s). It is put back into its start pose; the others are not affected.

        Returns:
            Rows of the simulations that broke, almost always none.
        """
        failed = self._step_silently(num_steps)
        # "not below" instead of "above": a comparison with NaN is false.
        if failed.size or self._warnings.any() or not np.abs(self._moving).max() < BEYOND_PHYSICS:
            return self._mend(failed)
        return failed

    def apply(self, function: Any, argument: Any, rows: np.ndarray) -> np.ndarray:
        """Run native code on some simulations, on native threads, and keep the states that it leaves.

        Args:
            function: of C, ``void function(const mjModel*, mjData*, int row, void* argument)``.
            argument: what it gets, as ctypes passes it.
            rows: which simulations, ``[N]``.

        Returns:
            Rows in which MuJoCo raised; they keep the states they had.
        """
        batch, states, status = self._native
        library, ids = mujoco_library(), np.ascontiguousarray(rows, dtype=np.int32)
        bodies = (ctypes.c_void_p * len(self._models))(*(model._address for model in self._models))
        library.mjb_setModels(batch, bodies)
        states[rows] = self.state[rows]
        with _SILENCE:
            library.mjb_apply(batch, ids.ctypes.data, len(ids), function, argument, 1)
        self.state[rows] = states[rows]
        return rows[status[rows] != 0]

    @functools.cached_property
    def _native(self) -> tuple[ctypes.c_void_p, np.ndarray, np.ndarray]:
        """A batch for :meth:`apply`, its states ``[K, n]`` and whether each simulation raised ``[K]``.

        `mujoco.batch.Batch` does not give the address of its own.
        """
        library, size = mujoco_library(), len(self._models)
        reason = ctypes.create_string_buffer(1000)
        config = _BatchConfig(self._num_threads, 0)
        batch = library.mjb_makeBatch(self._models[0]._address, size, ctypes.byref(config), reason, len(reason))
        if not batch:
            raise RuntimeError(f"MuJoCo makes no batch of {size} simulations: {reason.value.decode()}")
        weakref.finalize(self, library.mjb_deleteBatch, batch)
        states = np.ctypeslib.as_array(library.mjb_state(batch), self.state.shape)
        return batch, states, np.ctypeslib.as_array(library.mjb_status(batch), (size,))

    def lift_out_of_floor(self, row: int) -> None:
        """Lift a robot onto the floor if one of its parts is below it; one on a fixed base stays."""
        if self._height is not None and (lowest := self.lowest_point(row)) < 0:
            self.qpos[row, self._height] -= lowest

    def lowest_point(self, row: int) -> float:
        """Return the height in m of the lowest point of a robot, of the parts that can touch something."""
        model, data = self._posed(row)
        return lowest_point(model, data)

    def capsules(self, row: int) -> np.ndarray:
        """Return where the robot's parts are, as capsules, see `coim.envs.rods`.

        Returns:
            Both ends and the radius in m, ``[capsules, 7]``; the ends of a sphere are its centre.
        """
        model, data = self._posed(row)
        drawn = []
        for part in np.flatnonzero((model.geom_bodyid > 0) & np.isin(model.geom_type, DRAWN)).tolist():
            own, turn = rods_of(model, part), data.geom_xmat[part].reshape(3, 3)
            start, end = (data.geom_xpos[part] + own[:, at : at + 3] @ turn.T for at in (0, 3))
            drawn.append(np.hstack([start, end, own[:, 6:]]))
        return np.vstack(drawn) if drawn else np.zeros((0, 7))

    def _posed(self, row: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Return the body of a row, and its frames in its present pose."""
        model, data = self._models[row], self._scratch
        data.qpos[:] = self.qpos[row]
        mujoco.mj_kinematics(model, data)
        return model, data

    def _step_silently(self, num_steps: int) -> np.ndarray:
        """Step without writing MUJOCO_LOG.TXT to the user's folder; :meth:`step` returns the broken rows instead."""
        with _SILENCE:
            try:
                self._batch.step(nstep=num_steps)
            except SimulationError as error:
                return np.asarray(error.ids)
        return np.empty(0, dtype=np.int64)

    def _mend(self, failed: np.ndarray) -> np.ndarray:
        """Find the broken rows and start them again; this clears their warnings too."""
        broken = self._warnings.any(axis=1) | ~(np.abs(self._moving).max(axis=1) < BEYOND_PHYSICS)
        broken[failed] = True
        rows = np.flatnonzero(broken)
        self.start(rows)
        return rows


@functools.cache
def mujoco_library() -> ctypes.CDLL:
    """MuJoCo's own library, the one that its Python package has loaded."""
    (path,) = Path(mujoco.__file__).parent.glob("libmujoco*")
    library = ctypes.CDLL(str(path))
    pointer, number = ctypes.c_void_p, ctypes.c_int
    library.mjb_makeBatch.restype = pointer
    library.mjb_makeBatch.argtypes = [pointer, number, pointer, ctypes.c_char_p, number]
    library.mjb_deleteBatch.restype, library.mjb_deleteBatch.argtypes = None, [pointer]
    library.mjb_setModels.restype, library.mjb_setModels.argtypes = None, [pointer, pointer]
    library.mjb_apply.argtypes = [pointer, pointer, number, pointer, pointer, number]
    library.mjb_state.restype, library.mjb_state.argtypes = ctypes.POINTER(ctypes.c_double), [pointer]
    library.mjb_status.restype, library.mjb_status.argtypes = ctypes.POINTER(ctypes.c_int), [pointer]
    return library


def lowest_point(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Return the height in m of a robot's lowest point above z = 0, of the parts that can touch something.

    Args:
        model: the body; its parts are spheres, capsules, cylinders, boxes and ellipsoids.
        data: its frames, as ``mj_kinematics`` leaves them.
    """
    parts = colliding(model)
    kind, size = model.geom_type[parts], model.geom_size[parts]
    height, up = data.geom_xpos[parts, 2], np.abs(data.geom_xmat[parts, 6:])  # "up" in the axes of each part
    radius, half, slope = size[:, 0], size[:, 1], up[:, 2]
    end = height - half * slope
    lowest = np.select(
        [kind == SPHERE, kind == CAPSULE, kind == CYLINDER, kind == BOX, kind == ELLIPSOID],
        [
            height - radius,
            end - radius,
            end - radius * np.sqrt(np.maximum(1 - slope**2, 0)),
            height - (size * up).sum(1),
            height - np.sqrt(((size * up) ** 2).sum(1)),
        ],
        default=np.nan,
    )
    return float(lowest.min())


def start_clearance(model: mujoco.MjModel) -> float:
    """Return the height in m of a robot's lowest point above z = 0 in its start pose, all joints within their ranges.

    A start pose may be beyond them, as the ant's, whose legs are stretched out; the first steps drive it back.
    """
    data = mujoco.MjData(model)
    for joint in np.flatnonzero((model.jnt_limited == 1) & (model.jnt_type != FREE)):
        at = model.jnt_qposadr[joint]
        data.qpos[at] = np.clip(data.qpos[at], *model.jnt_range[joint])
    mujoco.mj_kinematics(model, data)
    return lowest_point(model, data)
