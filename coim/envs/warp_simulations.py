"""A fleet's physics by MuJoCo Warp, on a GPU: a world for each body, all stepped by the same kernels.

States stay where MuJoCo has them, in numpy, so that resets, checkpoints and pictures take no notice. A step brings them
to the device and back, some twenty numbers for each body.

Shapes: K simulations, D design.

References:
    MuJoCo Warp, https://github.com/google-deepmind/mujoco_warp. It computes in float32, and on a GPU the order of
    contacts, and with it the last bits, differs from one time to the next. It turns the sides of a friction pyramid
    otherwise than MuJoCo where a capsule stands upright on the floor, so that a free robot slips in other directions:
    see `docs/hardware.md`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from coim.envs.root import colliding
from coim.envs.simulation import Simulations

MOVING = ("qpos", "qvel", "act", "qacc_warmstart")  # what a step reads and changes
CONTACTS_OF_A_PART, LEAST_CONTACTS = 4, 16  # a box that lies on the floor has 4, two boxes have 8
# Each world could have its own, but what they are decides which kernels there are.
DECIDING = ("actuator_gainprm", "actuator_biasprm", "actuator_damping", "actuator_dampingpoly", "eq_data")
FOR_SLEEP = ("dof_length",)  # differs with lengths, and MuJoCo's batches have no bodies that sleep
OF_ONE_BODY, OF_ALL = ("NEFC", "NJMAX_NNZ"), ("BROADPHASE", "NARROWPHASE", "CCD")  # kinds of too little room


class WarpSimulations(Simulations):
    """K simulations of bodies with different lengths, stepped by MuJoCo Warp in float32.

    Keyword Args:
        device: as torch names it: ``cuda``, ``cuda:1``, or ``cpu``, which is slow and there to try it. The bodies stay
            there, whatever becomes of the tensors.

    Raises:
        ImportError: if MuJoCo Warp is not installed.
        NotImplementedError: if MuJoCo Warp does not know a part of the body; it names the part.
        ValueError: if bodies differ in something that all worlds share, such as the vertices of a mesh, if the robot
            has delays or joints that stay bent, which resets would not end, or if there is no such device.

    Other arguments, attributes and methods are those of :class:`~coim.envs.simulation.Simulations`.
    """

    def __init__(self, drawn: mujoco.MjSpec, *, device: str, **simulated: Any) -> None:
        super().__init__(drawn, **simulated)
        bound = {name: self._batch.bind(name) for name in MOVING}
        self._host = {name: value for name, value in bound.items() if value.size}
        self._time = self._batch.bind("time")
        self._worlds = Worlds(self._models, device=device)

    def build(self, rows: np.ndarray, designs: np.ndarray) -> None:
        """Give some simulations new bodies, see :meth:`~coim.envs.simulation.Simulations.build`."""
        before = self._models
        super().build(rows, designs)
        try:
            self._worlds.put(self._models)
        except ValueError:
            self._models = before
            self._batch.set_models(before)
            raise

    def apply(self, function: Any, argument: Any, rows: np.ndarray) -> np.ndarray:
        """Refuse native code, whose physics would be MuJoCo's."""
        raise RuntimeError("native code steps bodies by MuJoCo, and these are stepped by MuJoCo Warp; use step()")

    def _step_silently(self, num_steps: int) -> np.ndarray:
        self._worlds.step(num_steps, self._host, self.ctrl)
        self._time += num_steps * self._models[0].opt.timestep
        return np.empty(0, dtype=np.int64)


class Worlds:
    """The bodies as MuJoCo Warp has them on a device.

    Args:
        models: the compiled bodies, of one robot, ``[K]``.

    Keyword Args:
        device: as torch names it.

    Raises:
        ImportError: if MuJoCo Warp is not installed.
        NotImplementedError: if MuJoCo Warp does not know a part of the body.
        ValueError: if bodies differ in something that worlds share.
    """

    def __init__(self, models: Sequence[mujoco.MjModel], *, device: str) -> None:
        self._warp, self._mujoco_warp = warp, mujoco_warp = _packages()
        first = models[0]
        if first.nhistory or getattr(first, "nplastic", 0):
            raise ValueError(
                "the robot has delays or joints that stay bent, which MuJoCo Warp would keep through resets; take "
                "physics='mujoco'"
            )
        try:
            self._device = warp.get_device(device)
        except ValueError as error:
            raise ValueError(f"MuJoCo Warp cannot compute on {device!r} ({error}); take cuda, or cpu") from error
        kinds = {field.name: getattr(field.type, "shape", ()) for field in dataclasses.fields(mujoco_warp.Model)}
        # Fields with a value for each world; what the robot does not have at all is empty.
        own = [
            name
            for name, shape in kinds.items()
            if shape[:1] == ("*",) and np.size(getattr(first, name, ())) and name not in DECIDING
        ]
        self._shared = {
            name: np.array(value)
            for name, value in _values(first).items()
            if name.startswith("opt.") or (name in kinds and name not in (*own, *FOR_SLEEP))
        }
        contacts = max(CONTACTS_OF_A_PART * colliding(first).size, LEAST_CONTACTS)
        sides = 2 * max(first.geom_condim.max(initial=1), first.pair_dim.max(initial=1)) - 2  # of a friction pyramid
        constraints = max(int(sides), 1) * contacts + first.njnt + first.nv + 2 * first.ntendon + 6 * first.neq
        with warp.ScopedDevice(self._device):
            self._model = mujoco_warp.put_model(first, batch_sizes=dict.fromkeys(own, len(models)))
            self._model.opt.warn_overflow = 0  # our own error says it
            self._data = mujoco_warp.make_data(first, nworld=len(models), nconmax=contacts, njmax=constraints)
        self._there = {name: getattr(self._model, name) for name in own}
        # MuJoCo Warp leaves geoms that never move where they are when the data are made.
        self._there |= {name: getattr(self._data, name) for name in ("geom_xpos", "geom_xmat")}
        self._here = {name: there.numpy().copy() for name, there in self._there.items()}
        for name in own:
            if not np.array_equal(self._here[name][0], _shaped(getattr(first, name), self._here[name])):
                raise ValueError(f"MuJoCo Warp {mujoco_warp.__version__} keeps {name!r} in an order of its own")
        self._models: list[mujoco.MjModel | None] = [None] * len(models)
        self.put(models)
        self._graphs: dict[int, Any] = {}

    def put(self, models: Sequence[mujoco.MjModel]) -> None:
        """Take the bodies of all worlds; captured steps read them where they lie.

        Raises:
            ValueError: if a body differs from the first in something that all worlds share. The bodies stay as they
                were.
        """
        new = [row for row, (model, before) in enumerate(zip(models, self._models)) if model is not before]
        for model in {id(models[row]): models[row] for row in new}.values():
            values = _values(model)
            for name, value in self._shared.items():
                if not np.array_equal(values[name], value):
                    raise ValueError(
                        f"a body differs from the first in {name!r}, which bodies share with MuJoCo Warp; take "
                        "physics='mujoco'"
                    )
        for row in new:
            model = models[row]
            data = mujoco.MjData(model)
            mujoco.mj_kinematics(model, data)
            for name, here in self._here.items():
                here[row] = _shaped(getattr(data if name in ("geom_xpos", "geom_xmat") else model, name), here)
        with self._warp.ScopedDevice(self._device):
            for name, there in self._there.items():
                there.assign(self._here[name])
        self._models = list(models)

    def step(self, num_steps: int, moving: dict[str, np.ndarray], ctrl: np.ndarray) -> None:
        """Advance all worlds, and write where they are.

        Args:
            num_steps: simulation steps.
            moving: what of :data:`MOVING` there is, ``[K, n]`` each; written to.
            ctrl: motor commands, ``[K, nu]``.

        Raises:
            RuntimeError: if there are more contacts or constraints than there is room for; nothing has moved then.
        """
        data = self._data
        with self._warp.ScopedDevice(self._device):
            self._bring(moving, ctrl)
            if not self._device.is_cuda:
                self._advance(num_steps)
            else:
                if num_steps not in self._graphs:
                    self._mujoco_warp.step(self._model, data)  # compiles and loads the kernels, which a capture cannot
                    with self._warp.ScopedCapture() as capture:
                        self._advance(num_steps)
                    self._graphs[num_steps] = capture.graph
                    self._bring(moving, ctrl)
                self._warp.capture_launch(self._graphs[num_steps])
            self._check_room()
            for name, value in moving.items():
                value[:] = getattr(data, name).numpy()

    def _check_room(self) -> None:
        kinds, found = self._mujoco_warp.OverflowType, self._data.overflow.numpy()
        one, all_ = (sum(int(kinds[name]) for name in names) for names in (OF_ONE_BODY, OF_ALL))
        if not (found & (one | all_)).any():
            return
        what = f"the bodies touch in more than {self._data.naconmax} places"
        if not (found & all_).any():
            row = int(((found & one) != 0).argmax())
            what = (
                f"body {row} has more than {self._data.njmax} constraints, of contacts, joints, tendons and equalities"
            )
        raise RuntimeError(f"{what}, for which MuJoCo Warp was given room; take physics='mujoco'")

    def _bring(self, moving: dict[str, np.ndarray], ctrl: np.ndarray) -> None:
        """Bring states and commands to the device, and forget what did not fit before."""
        for name, value in {**moving, "ctrl": ctrl}.items():
            getattr(self._data, name).assign(value.astype(np.float32))
        self._data.overflow.zero_()

    def _advance(self, num_steps: int) -> None:
        for _ in range(num_steps):
            self._mujoco_warp.step(self._model, self._data)


def _values(model: mujoco.MjModel) -> dict[str, Any]:
    """The numbers and arrays of a body, and its options, by name."""
    fields = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    options = {f"opt.{name}": getattr(model.opt, name) for name in dir(model.opt) if not name.startswith("_")}
    return {name: value for name, value in (fields | options).items() if isinstance(value, np.ndarray | int | float)}


def _shaped(value: Any, rows: np.ndarray) -> np.ndarray:
    """A field of a body in the shape and the precision of a row of what the device has."""
    return np.asarray(value).reshape(rows.shape[1:]).astype(rows.dtype)


def _packages() -> tuple[Any, Any]:
    """Warp and MuJoCo Warp, which the library does without until they are asked for."""
    try:
        import warp

        warp.config.log_level = max(warp.config.log_level, warp.LOG_WARNING)  # or every kernel that is loaded is a line
        import mujoco_warp
    except ImportError as error:
        raise ImportError(
            f"physics 'warp' is computed by MuJoCo Warp ({error}); pip install 'coim[warp]', or physics='mujoco'"
        ) from error
    return warp, mujoco_warp
