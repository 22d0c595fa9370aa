"""Pictures of a body, without a screen.

The bodies have no textures, so that they compile fast. A picture needs textures to show the motion over the ground: a
copy of the body gets a sky and a chequered floor, in negligible time. Without a graphics card the first picture takes
about 0.3 s, mostly to set up OpenGL, and each one of 640 x 480 pixels about 20 ms.
"""

from __future__ import annotations

import importlib
import os
import sys
import warnings
from typing import Any, Self

import mujoco
import numpy as np

from coim.envs.root import Root, find_floor, find_height

PERIOD = 2.0  # m, period of the chequered floor: two squares of 1 m, which MuJoCo draws with texrepeat 1 (measured)
# Texels along a side of the shadow map, and samples of a pixel. Without a graphics card a picture takes 17 ms with
# these and 40 ms with 1024 and MuJoCo's 4 samples, and looks the same.
SHADOWS, SAMPLES = 512, 0
SKY = mujoco.mjtTexture.mjTEXTURE_SKYBOX
SCREENS = ("DISPLAY", "WAYLAND_DISPLAY")  # environment variables that name a display, on Linux
ROOM = 0.1  # share of a moving robot's size that is left free on each side of it
FROM_ABOVE = -25.0  # degrees, elevation of the camera of a robot that does not move in a plane
ASIDE = 20.0  # degrees by which drawings of lines look along the way of a free robot, so that no leg hides another
MISSING_GL = (
    "no picture without OpenGL: install a library that draws without a screen "
    "(Debian: apt-get install libegl1 libegl-mesa0), and unset the environment variable MUJOCO_GL or set "
    "MUJOCO_GL=egl before Python starts"
)


class Camera:
    """A camera that follows one body; close it, or use it in a ``with`` block.

    Args:
        spec: the body; it is not changed.
        width: pixels.
        height: pixels.
        root: how the body moves.
        name: a camera of the file; by default its first one, or one on the right side of the body that follows it.

    Raises:
        ValueError: if the file has no camera of that name.
        RuntimeError: if there is no OpenGL to draw with; the message says what to install and set.
    """

    def __init__(self, spec: mujoco.MjSpec, *, width: int, height: int, root: Root, name: str | None = None) -> None:
        self._travelled = root.unseen
        self._model = dress(spec, width, height).compile()
        self._data = mujoco.MjData(self._model)
        self._view = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(self._model, self._view)
        self._view.azimuth, self._view.elevation = 90.0, -8.0 if root.kind == "planar" else FROM_ABOVE
        if name is not None or self._model.ncam:
            self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED
            self._view.fixedcamid = _camera_number(self._model, name)
        try:
            _draw_without_screen()
            with warnings.catch_warnings():  # glfw warns about the missing screen before mujoco raises
                warnings.simplefilter("ignore")
                self._renderer = mujoco.Renderer(self._model, height, width)
        except (mujoco.FatalError, ImportError, RuntimeError) as error:
            raise RuntimeError(MISSING_GL) from error

    def photograph(self, qpos: np.ndarray) -> np.ndarray:
        """Draw the body in a pose.

        Args:
            qpos: joint positions, ``[nq]``; the first ones are the place on the ground in m.

        Returns:
            The picture, ``[height, width, 3]`` uint8.
        """
        self._data.qpos[:] = qpos
        # Draw the body within one period of the floor: it looks the same, and stays on the floor and in the light.
        for axis in range(self._travelled):
            self._data.qpos[axis] = self._view.lookat[axis] = qpos[axis] % PERIOD
        mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, self._view)
        return self._renderer.render()

    def close(self) -> None:
        """Free the resources of OpenGL."""
        self._renderer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def drawn_axes(root: Root) -> np.ndarray:
    """From where a body is drawn by lines: the directions right, up and towards the viewer, ``[3, 3]``.

    A robot with a free root is seen from the side, a little from above and behind, in parallel projection; any other
    one from the side alone.

    Example:
        >>> drawn_axes(Root(kind="planar", unseen=1, height=1, quaternion=None, angles=())).tolist()
        [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
    """
    if root.kind != "free":
        return np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    (sin_a, sin_e), (cos_a, cos_e) = (f(np.radians([ASIDE, FROM_ABOVE])) for f in (np.sin, np.cos))
    right = [cos_a, -sin_a, 0.0]
    return np.array([right, [-sin_e * sin_a, -sin_e * cos_a, cos_e], [-cos_e * sin_a, -cos_e * cos_a, -sin_e]])


def make_room(spec: mujoco.MjSpec, largest: mujoco.MjModel) -> None:
    """Let pictures of a body have room for the largest one, in place, if its file has no ``<statistic>`` that says so.

    MuJoCo would count the floor too, in which a robot of half a metre is a few pixels wide.

    Args:
        spec: the body to be drawn.
        largest: the longest body of its class, so that all are drawn to one scale.
    """
    if not np.isnan(spec.stat.extent):
        return
    data = mujoco.MjData(largest)
    mujoco.mj_kinematics(largest, data)
    parts = largest.geom_bodyid > 0
    turns = data.geom_xmat[parts].reshape(-1, 3, 3)
    middles = data.geom_xpos[parts] + (turns @ largest.geom_aabb[parts, :3, None])[..., 0]
    halves = (np.abs(turns) @ largest.geom_aabb[parts, 3:, None])[..., 0]
    low, high = (middles - halves).min(0), (middles + halves).max(0)
    if find_height(largest) is None:  # it reaches as far to every side of its base
        base = data.xpos[largest.body_rootid[largest.geom_bodyid[parts][0]]]
        reach = np.maximum(np.abs(high - base), np.abs(low - base)).max()
        low, high = base - reach, base + reach
    else:
        low[2] = min(low[2], 0.0)  # with the floor under it
        low, high = low - ROOM * (high - low), high + ROOM * (high - low)
    spec.stat.extent, spec.stat.center = (high - low).max(), (low + high) / 2


def dress(spec: mujoco.MjSpec, width: int, height: int) -> mujoco.MjSpec:
    """Return a copy with a sky, a floor of 1 m squares, and an off-screen buffer of the size of the picture.

    A file without a light gets one from above.
    """
    spec = spec.copy()
    floor = find_floor(spec.compile())
    spec.visual.global_.offwidth = width
    spec.visual.global_.offheight = height
    spec.visual.quality.shadowsize, spec.visual.quality.offsamples = SHADOWS, SAMPLES
    if all(texture.type != SKY for texture in spec.textures):
        spec.add_texture(
            name="coim sky",
            type=SKY,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
            rgb1=[0.75, 0.85, 0.95],
            rgb2=[1.0, 1.0, 1.0],
            width=64,
            height=64,
        )
    if not spec.lights:
        sun = spec.worldbody.add_light(pos=[0, 0, 1.3], diffuse=[0.7, 0.7, 0.7], specular=[0.1, 0.1, 0.1])
        sun.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        sun.mode = mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM  # its shadows are those of the few metres around it
    if floor is None:
        return spec
    spec.add_texture(
        name="coim chequers",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.62, 0.68, 0.62],
        rgb2=[0.80, 0.86, 0.80],
        width=128,
        height=128,
    )
    tiles = spec.add_material(name="coim floor", texuniform=True, texrepeat=[2 / PERIOD, 2 / PERIOD])
    tiles.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "coim chequers"
    spec.geoms[floor].material = "coim floor"
    return spec


def _camera_number(model: mujoco.MjModel, name: str | None) -> int:
    """Return the number of a camera of the file, by default of the first one."""
    cameras = [model.camera(number).name for number in range(model.ncam)]
    if name is not None and name not in cameras:
        raise ValueError(f"CAMERA is {name!r}, and the file has the cameras {cameras}; choose one of them, or None")
    return 0 if name is None else cameras.index(name)


def has_screen() -> bool:
    """Whether a display is named, on Linux; elsewhere there always is one."""
    return sys.platform != "linux" or any(os.environ.get(name) for name in SCREENS)


def _draw_without_screen() -> None:
    """Let MuJoCo draw by EGL where there is no screen and nobody has chosen otherwise by ``MUJOCO_GL``.

    MuJoCo reads ``MUJOCO_GL`` when it is imported, and ``import coim`` has done that: so it chooses once more.

    Raises:
        ImportError: if the library is not installed.
    """
    if has_screen() or "MUJOCO_GL" in os.environ:
        return
    os.environ["MUJOCO_GL"] = "egl"
    renderer: Any = sys.modules[mujoco.Renderer.__module__]  # where it lies differs between versions
    try:
        importlib.reload(renderer.gl_context)
    except AttributeError as error:  # of PyOpenGL, which finds no such library
        del os.environ["MUJOCO_GL"]  # processes that we start could not import mujoco by it
        raise ImportError("there is no EGL") from error
