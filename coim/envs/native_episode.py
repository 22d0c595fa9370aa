"""Whole episodes as native code: ``native_episode.cpp``, made by a C++ compiler where they are first needed.

In Python a step of one body takes 2.5 to 4.6 times as long as its physics: some thirty calls of torch, numpy and
MuJoCo, each of a few microseconds. Here the bodies, which do not depend on each other, go through their episode one by
one, or as many at once as there are threads.

Shapes: T steps, K runs, S observation, D design, A action.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from coim.envs.fleet import not_finite
from coim.envs.morph import MorphEnv
from coim.envs.simulation import BEYOND_PHYSICS, mujoco_library
from coim.native import Source

SOURCE = Source(
    path=Path(__file__).with_suffix(".cpp"),
    # Sums in the order that they are written in, and products that are fused only where the source says so.
    options=("-O3", "-ffp-contract=off", f"-I{Path(mujoco.__file__).parent / 'include'}"),
    made_from=mujoco.__version__,
    purpose="native episodes",
    way_out="leave native episodes out",
)
BROKEN, NOT_FINITE = 1, 2  # as in the source
AT_ONCE = 5_000  # steps of all bodies in a call, about half a second: only between calls does Python hear Ctrl-C


class _Layer(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in ("weight", "bias")] + [
        (name, ctypes.c_int64) for name in ("next_weight", "next_bias", "inputs", "outputs")
    ]


class _Episode(ctypes.Structure):
    """As in the source, where the fields are explained."""

    _fields_ = (
        [("step", ctypes.c_void_p)]
        + [(name, ctypes.c_int64) for name in ("bodies", "steps", "substeps", "observed", "designed", "acted")]
        + [(name, ctypes.c_int64) for name in ("unseen", "angles", "layers", "width")]
        + [(name, ctypes.c_void_p) for name in ("angle", "middle", "reach")]
        + [("beyond", ctypes.c_double)]
        + [(name, ctypes.c_void_p) for name in ("layer", "scale", "design", "noise")]
        + [("least", ctypes.c_float), ("most", ctypes.c_float)]
        + [(name, ctypes.c_void_p) for name in ("observation", "action", "following", "scratch", "next", "ending")]
    )


@dataclass(frozen=True)
class Actor:
    """A tanh-Gaussian policy of ReLU layers, as the constants of an episode.

    Attributes:
        layers: weight ``[inputs, outputs]`` and bias ``[outputs]`` of each layer; ``[K, inputs, outputs]`` and
            ``[K, outputs]`` if every run has a policy of its own. The last layer returns ``loc`` and the log-scale.
        observation_scale: ``[S]``, by which observations are divided.
        design: ``[K, D]``, as the network reads it.
        log_scale_range: least and largest log-scale.
    """

    layers: Sequence[tuple[Tensor, Tensor]]
    observation_scale: Tensor
    design: Tensor
    log_scale_range: tuple[float, float]

    def fits(self, env: MorphEnv) -> bool:
        """Whether the sizes are those of the bodies, and all numbers finite, in float32 and on the CPU.

        Others act in Python, which says what is wrong with them.
        """
        runs, acted = env.action_spec.shape
        observed = env.observation_spec["observation"].shape[-1]
        tensors = [self.observation_scale, self.design, *(tensor for layer in self.layers for tensor in layer)]
        if {(tensor.dtype, tensor.device.type) for tensor in tensors} != {(torch.float32, "cpu")}:
            return False
        sizes = [observed + self.design.shape[-1], *(bias.shape[-1] for _, bias in self.layers)]
        own = [runs] if self.layers[0][0].dim() == 3 else []
        return (
            self.observation_scale.shape == (observed,)
            and self.design.shape == env.state_spec["design"].shape
            and sizes[-1] == 2 * acted
            and all(
                [*weight.shape] == [*own, inputs, outputs] and [*bias.shape] == [*own, outputs]
                for (weight, bias), inputs, outputs in zip(self.layers, sizes[:-1], sizes[1:])
            )
            and all(bool(tensor.isfinite().all()) for tensor in tensors)
        )


@dataclass(frozen=True)
class Rows:
    """Where an episode is written, all on the CPU.

    Attributes:
        observation: ``[T, K, S]``.
        action: ``[T, K, A]``.
        following: ``[T, K, S]``, the next observations.
        broken: ``[T, K, 1]`` bool, whether the simulation broke in this step.
    """

    observation: Tensor
    action: Tensor
    following: Tensor
    broken: Tensor


def play(env: MorphEnv, actor: Actor, noise: Tensor | None, rows: Rows) -> None:
    """Let the bodies act from where they stand, and write the rows.

    A body whose simulation breaks starts again, as in `coim.run_episode`.

    Args:
        env: the bodies.
        actor: their policies.
        noise: standard normal, ``[T, K, A]``; None acts by the mode.
        rows: to be written to, with ``broken`` all False.

    Raises:
        ValueError: if an action is not finite; other bodies may have moved on to their last step.
        RuntimeError: if the code cannot be compiled.
    """
    steps, bodies = rows.broken.shape[:2]
    keep: list[Tensor] = []  # what the pointers point to

    def pointer(tensor: Tensor | None) -> int | None:
        if tensor is None:
            return None
        keep.append(tensor)
        return tensor.data_ptr()

    layers = (_Layer * len(actor.layers))()
    for layer, (weight, bias) in zip(layers, actor.layers):
        own = weight.dim() == 3  # one for each body, which may lie apart
        weight, bias = (x if (x[0] if own else x).is_contiguous() else x.contiguous() for x in (weight, bias))
        layer.weight, layer.bias = pointer(weight), pointer(bias)
        layer.next_weight, layer.next_bias = (weight.stride(0), bias.stride(0)) if own else (0, 0)
        layer.inputs, layer.outputs = weight.shape[-2:]
    width = max(max(layer.inputs, layer.outputs) for layer in layers)
    angles = torch.tensor([entry - env.first_position for entry in env.root.angles], dtype=torch.int64, device="cpu")
    middle, reach = (None, None) if env.motor_range is None else map(torch.from_numpy, env.motor_range)
    upcoming = torch.zeros(bodies, dtype=torch.int64, device="cpu")
    ending = torch.zeros(bodies, dtype=torch.int64, device="cpu")
    episode = _Episode(
        step=ctypes.cast(mujoco_library().mj_step, ctypes.c_void_p),
        bodies=bodies,
        steps=0,  # so far in this call
        substeps=env.FRAME_SKIP,
        observed=rows.observation.shape[-1],
        designed=actor.design.shape[-1],
        acted=rows.action.shape[-1],
        unseen=env.first_position,
        angles=len(angles),
        layers=len(layers),
        width=width,
        angle=pointer(angles),
        middle=pointer(middle),
        reach=pointer(reach),
        beyond=BEYOND_PHYSICS,
        layer=ctypes.cast(layers, ctypes.c_void_p),
        scale=pointer(actor.observation_scale.contiguous()),
        design=pointer(actor.design.contiguous()),
        noise=pointer(None if noise is None else noise.contiguous()),
        least=actor.log_scale_range[0],
        most=actor.log_scale_range[1],
        observation=pointer(rows.observation),
        action=pointer(rows.action),
        following=pointer(rows.following),
        scratch=pointer(torch.empty(bodies, 2 * width, dtype=torch.float32, device="cpu")),
        next=pointer(upcoming),
        ending=pointer(ending),
    )
    to_go = np.arange(bodies)
    while to_go.size:
        before = upcoming.clone()
        episode.steps = min(steps, int(upcoming[to_go].min()) + max(1, AT_ONCE // len(to_go)))
        ending.zero_()
        failed = env.simulations.apply(library().act, ctypes.byref(episode), to_go)
        for row in failed:  # MuJoCo raised within a step: it is the last one, and leads nowhere
            at = int(upcoming[row])
            rows.following[at, row] = rows.observation[at, row]
            upcoming[row], ending[row] = at + 1, BROKEN
        broken = (ending == BROKEN).numpy()
        env.have_moved(to_go[~broken[to_go]], upcoming - before)
        if broken.any():
            rows.broken[upcoming.numpy()[broken] - 1, np.flatnonzero(broken)] = True
            env.num_broken += torch.from_numpy(broken)
            again = torch.from_numpy(broken).unsqueeze(-1)
            env.reset(TensorDict({"_reset": again}, env.batch_size, device=env.device))
        if (ending == NOT_FINITE).any():
            row = int((ending == NOT_FINITE).nonzero()[0])
            raise not_finite(rows.action[upcoming[row], row])
        to_go = np.flatnonzero((upcoming < steps).numpy())


def can_be_native() -> bool:
    """Whether there is native code of episodes on this machine, or it can be made."""
    try:
        library()
    except RuntimeError:
        return False
    return True


@functools.cache
def library() -> ctypes.CDLL:
    """The compiled source.

    Raises:
        RuntimeError: if it cannot be compiled, see `coim.native.Source.library`.
    """
    return SOURCE.library()
