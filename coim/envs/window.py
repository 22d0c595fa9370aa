"""A body that is shown while it moves: in MuJoCo's own window, which the mouse turns and zooms, or on a page."""

from __future__ import annotations

import time

import mujoco
import numpy as np

from coim.envs.camera import PERIOD, SCREENS, dress, has_screen
from coim.envs.root import Root

PICTURE = 480  # pixels along a side of the off-screen buffer, which a window does not use


class Figure:
    """A body to be shown, in the pose that it is given.

    Args:
        spec: the body; it is not changed.
        root: how the body moves.

    Attributes:
        model: the body with sky and floor.
        data: its pose.
    """

    def __init__(self, spec: mujoco.MjSpec, *, root: Root) -> None:
        self._travelled = root.unseen
        self.model = dress(spec, PICTURE, PICTURE).compile()
        self.data = mujoco.MjData(self.model)

    def pose(self, qpos: np.ndarray, *, qvel: np.ndarray | float = 0.0, ctrl: np.ndarray | float = 0.0) -> None:
        """Take a pose.

        Args:
            qpos: joint positions, ``[nq]``; the first ones are the place on the ground in m.
            qvel: joint velocities, ``[nv]``; forces are those of this motion.
            ctrl: of the motors, ``[nu]``.
        """
        self.data.qpos[:], self.data.qvel[:], self.data.ctrl[:] = qpos, qvel, ctrl
        for axis in range(self._travelled):  # as in `Camera.photograph`
            self.data.qpos[axis] = qpos[axis] % PERIOD
        mujoco.mj_forward(self.model, self.data)


class Window:
    """A window with one body, in real time. After its user has closed it, nothing more is shown.

    Args:
        spec: the body; it is not changed.
        root: how the body moves.
        step_seconds: simulated time between two poses, s.

    Raises:
        RuntimeError: if there is no display; see `refuse_without_display`.
    """

    def __init__(self, spec: mujoco.MjSpec, *, root: Root, step_seconds: float) -> None:
        refuse_without_display()
        from mujoco import viewer  # opens the window system, which a machine without a display does not have

        self._travelled, self._step_seconds, self._due = root.unseen, step_seconds, time.monotonic()
        self._figure = Figure(spec, root=root)
        model, data = self._figure.model, self._figure.data
        self._handle = viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
        with self._handle.lock():
            mujoco.mjv_defaultFreeCamera(model, self._handle.cam)
            self._handle.cam.azimuth, self._handle.cam.elevation = 90.0, -8.0 if root.kind == "planar" else -25.0

    def show(self, qpos: np.ndarray) -> None:
        """Show a pose when its time has come.

        Args:
            qpos: joint positions, ``[nq]``; the first ones are the place on the ground in m.
        """
        if not self._handle.is_running():
            return
        with self._handle.lock():
            self._figure.pose(qpos)
            self._handle.cam.lookat[: self._travelled] = self._figure.data.qpos[: self._travelled]
        self._handle.sync()
        self._due = max(self._due + self._step_seconds, time.monotonic())
        time.sleep(max(0.0, self._due - time.monotonic()))

    def close(self) -> None:
        """Close the window."""
        self._handle.close()


def refuse_without_display() -> None:
    """Refuse a window where none can be opened.

    Raises:
        RuntimeError: if no display is named, on Linux; elsewhere there always is one.
    """
    if not has_screen():
        raise RuntimeError(
            f"a window needs a display, and none of {', '.join(SCREENS)} names one: take render_mode='rgb_array', "
            "which draws without one, or start it under a display such as xvfb-run"
        )
