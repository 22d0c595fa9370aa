"""A fleet's physics by MuJoCo Warp, on a GPU: a world for each body, all stepped by the same kernels.

States stay where MuJoCo has them, in numpy, so that resets, checkpoints and pictures take no notice. A step brings them
to the device and back, some twenty numbers for each body.

Shapes: K simulations, D design.

References:
    MuJoCo Warp, https://github.com/google-deepmind/mujoco_warp. It computes in float32, and on a GPU the order of
    contacts, and with it the last bits, differs from one time to the next. Where masses of very different size touch
    something, as the ant's light body and its heavy joints, float32 is not enough: see `docs/hardware.md`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np

from coim.envs.root import colliding
from coim.envs.simulation import Simulations

MOVING = ("qpos", "qvel", "act", "qacc_warmstart")  # what a step reads and changes
CONTACTS_OF_A_PART = 4  # of a box that lies on the floor; a capsule has two
FOR_SLEEP = ("dof_length",)  # worlds share it, and only robots that may fall asleep need it
# Each world could have its own, but what they are decides which kernels there are.
DECIDING = ("actuator_gainprm", "actuator_biasprm", "actuator_damping", "actuator_dampingpoly", "eq_data")
LACKS_ROOM = ("NEFC", "NJMAX_NNZ", "BROADPHASE", "NARROWPHASE", "CCD")  # of MuJoCo Warp's OverflowType


class WarpSimulations(Simulations):
    """K simulations of bodies with different lengths, stepped by MuJoCo Warp in float32.

    Keyword Args:
        device: as torch names it: ``cuda``, ``cuda:1``, or ``cpu``, which is slow and there to try it.

    Raises:
        ImportError: if MuJoCo Warp is not installed.
        NotImplementedError: if MuJoCo Warp does not know a part of the body; it names the part.
        ValueError: if bodies differ in something of which there is one for all worlds, such as the vertices of a mesh.

    Other arguments, attributes and methods are those of :class:`~coim.envs.simulation.Simulations`.
    """

    def __init__(
        self,
        drawn: mujoco.MjSpec,
        *,
        shape_body: Callable[[mujoco.MjSpec, np.ndarray], None],
        designs: np.ndarray,
        num_threads: int,
        device: str,
    ) -> None:
        super().__init__(drawn, shape_body=shape_body, designs=designs, num_threads=num_threads)
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
        self._device = warp.get_device(device)
        first = models[0]
        fields = {field.name: field.type for field in dataclasses.fields(mujoco_warp.Model)}
        # Fields with a value for each world; what the robot does not have at all is empty.
        own = [
            name
            for name, kind in fields.items()
            if getattr(kind, "shape", ("",))[:1] == ("*",)
            and np.size(getattr(first, name, ()))
            and name not in DECIDING
        ]
        sleeps = first.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP
        differing = own if sleeps else [*own, *FOR_SLEEP]
        self._shared = {
            name: np.array(value)
            for name, value in _values(first).items()
            if name.startswith("opt.") or (name in fields and name not in differing)
        }
        parts = int(colliding(first).sum())
        contacts = max(1, CONTACTS_OF_A_PART * parts)
        rows = 2 * (int(first.geom_condim.max()) - 1) or 1  # sides of a friction pyramid
        with warp.ScopedDevice(self._device):
            self._model = mujoco_warp.put_model(first, batch_sizes=dict.fromkeys(own, len(models)))
            self._model.opt.warn_overflow = 0  # our own error says it
            self._own = {name: getattr(self._model, name) for name in own}
            self._check_order(first)
            self.put(models)
            self._data = mujoco_warp.make_data(
                first, nworld=len(models), nconmax=contacts, njmax=first.njnt + first.nv + rows * contacts
            )
        self._graphs: dict[int, Any] = {}
        self._lacks_room = sum(int(mujoco_warp.OverflowType[name]) for name in LACKS_ROOM)

    def put(self, models: Sequence[mujoco.MjModel]) -> None:
        """Take the bodies of all worlds; captured steps read them where they lie.

        Raises:
            ValueError: if bodies differ in something that worlds share. The bodies stay as they were.
        """
        for model in models:
            values = _values(model)
            for name, value in self._shared.items():
                if not np.array_equal(values[name], value):
                    raise ValueError(
                        f"a body differs from the first in {name!r}, of which MuJoCo Warp has one for all worlds; take "
                        "physics='mujoco'"
                    )
        for name, there in self._own.items():
            rows = np.stack([getattr(model, name) for model in models])
            there.assign(rows.reshape(there.numpy().shape))

    def step(self, num_steps: int, moving: dict[str, np.ndarray], ctrl: np.ndarray) -> None:
        """Advance all worlds, and write where they are.

        Args:
            num_steps: simulation steps.
            moving: what of :data:`MOVING` there is, ``[K, n]`` each; written to.
            ctrl: motor commands, ``[K, nu]``.

        Raises:
            RuntimeError: if a body touches more than there is room for.
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
            for name, value in moving.items():
                value[:] = getattr(data, name).numpy()
            lacks_room = (data.overflow.numpy() & self._lacks_room) != 0
        if lacks_room.any():
            raise RuntimeError(
                f"body {int(lacks_room.argmax())} touches more than MuJoCo Warp was given room for ({data.naconmax} "
                f"contacts of all bodies, {data.njmax} constraints of each); take physics='mujoco'"
            )

    def _bring(self, moving: dict[str, np.ndarray], ctrl: np.ndarray) -> None:
        """Bring states and commands to the device, and forget what did not fit before."""
        for name, value in {**moving, "ctrl": ctrl}.items():
            getattr(self._data, name).assign(value.astype(np.float32))
        self._data.overflow.zero_()

    def _advance(self, num_steps: int) -> None:
        for _ in range(num_steps):
            self._mujoco_warp.step(self._model, self._data)

    def _check_order(self, first: mujoco.MjModel) -> None:
        """Refuse a version of MuJoCo Warp that orders a field in another way than MuJoCo."""
        for name, there in self._own.items():
            values = there.numpy()
            expected = np.broadcast_to(np.reshape(getattr(first, name), values.shape[1:]), values.shape)
            if not np.array_equal(values, expected.astype(values.dtype)):
                raise ValueError(f"MuJoCo Warp {self._mujoco_warp.__version__} keeps {name!r} in an order of its own")


def _values(model: mujoco.MjModel) -> dict[str, Any]:
    """The numbers and arrays of a body, and its options, by name."""
    fields = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    options = {f"opt.{name}": getattr(model.opt, name) for name in dir(model.opt) if not name.startswith("_")}
    return {name: value for name, value in (fields | options).items() if isinstance(value, np.ndarray | int | float)}


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
