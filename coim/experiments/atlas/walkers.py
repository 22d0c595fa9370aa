"""What the page needs to let a robot walk: its body, its policies, and walks that were recorded.

Shapes: T frames, G capsules, S observation, D design.
"""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from tensordict import TensorDict
from torch import Tensor

from coim.envs import MorphEnv
from coim.envs.camera import drawn_axes
from coim.envs.root import FREE
from coim.envs.written_body import WrittenBody, written_body
from coim.models import Policy

FRAMES_PER_SECOND = 30
RECORDED_SECONDS = 8.0
STATES = 64  # of a walk, for gradients over visited states


def encoded(values: ArrayLike) -> str:
    """Numbers as little-endian float32 in base64.

    Example:
        >>> encoded([1.0])
        'AACAPw=='
    """
    return base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode()


def body_table(bodies: MorphEnv) -> dict[str, Any]:
    """The body as text with slots, and how its positions are read and its motors driven; ``text`` is None without.

    A body that cannot be written as text is not simulated in the page; ``why`` says so.
    """
    written: WrittenBody | None = None
    why = ""
    try:
        written = written_body(bodies)
    except ValueError as error:
        why = str(error)
    clearance = None if written is None or written.clearance is None else written.clearance.tolist()
    return {
        "texts": None if written is None else written.texts,
        "slots": [] if written is None else written.slots.tolist(),
        "clearance": clearance,
        "why": why,
        "frame_skip": bodies.FRAME_SKIP,
        "step_seconds": bodies.step_seconds,
        "first_position": bodies.simulations.qpos.shape[1] - _num_positions(bodies),
        "height": bodies.root.height,
        "axes": drawn_axes(bodies.root).tolist(),
        "angles": list(bodies.angle_indices),
        "ranges": _ranges(bodies),
        "names": list(bodies.design_names()),
        "low": bodies.design_bounds()[0].tolist(),
        "high": bodies.design_bounds()[1].tolist(),
    }


def _ranges(bodies: MorphEnv) -> list[tuple[int, float, float]]:
    """Place in the positions, least and largest value of each joint with limits, which are the same in all designs."""
    model = bodies.simulations.model(0)
    limited = np.flatnonzero((model.jnt_limited == 1) & (model.jnt_type != FREE))
    places, (lows, highs) = model.jnt_qposadr[limited], model.jnt_range[limited].T
    return list(zip(places.tolist(), lows.tolist(), highs.tolist()))


def policy_table(policy: Policy) -> dict[str, Any]:
    """A policy's deterministic action as plain arrays: scales of its inputs, and layers of weights ``[in, out]``."""
    network = policy.network
    parameters = [parameter.detach() for parameter in network.mlp.parameters()]
    layers = list(zip(parameters[0::2], parameters[1::2]))
    num_actions = layers[-1][1].shape[-1] // 2
    layers[-1] = (layers[-1][0][:, :num_actions], layers[-1][1][:num_actions])  # without the log-scales
    scaling = network.scaling
    return {
        "observation_scale": None if scaling is None else scaling.observation_scale.tolist(),
        "design_centre": None if scaling is None else scaling.design_centre.tolist(),
        "design_reach": None if scaling is None else scaling.design_reach.tolist(),
        "layers": [
            {"width": weight.shape[1], "weights": encoded(weight.numpy()), "bias": encoded(bias.numpy())}
            for weight, bias in layers
        ],
    }


def outlines(body: type[MorphEnv], designs: np.ndarray) -> list[list[list[float]]]:
    """Capsules of bodies at rest: x, y and z of both ends and the radius in m, ``[N, G, 7]``.

    Args:
        body: the environment that the designs belong to.
        designs: ``[N, D]``.
    """
    env = body(num_runs=len(designs), reset_noise=0, seed=0)
    env.reset(TensorDict({"design": torch.tensor(designs, dtype=torch.float32)}, [len(designs)]))
    return [env.capsules(row).numpy().round(4).tolist() for row in range(len(designs))]


@dataclass(frozen=True)
class Walk:
    """The first seconds of an episode.

    Attributes:
        frames: x, y and z of both ends of each capsule in m, at 30 frames a second, ``[T, G, 6]``.
        observation: states visited on the way, ``[n, S]``.
        design: ``[D]``.
    """

    frames: np.ndarray
    observation: Tensor
    design: Tensor

    def table(self) -> dict[str, Any]:
        """The walk as the page reads it."""
        return {"num_frames": len(self.frames), "frames": encoded(self.frames)}


@torch.no_grad()
def record_walk(bodies: MorphEnv, policy: Policy, design: Tensor, *, seconds: float = RECORDED_SECONDS) -> Walk:
    """Let one body walk by its policy's deterministic actions.

    Args:
        bodies: a fleet of one.
        policy: without a run axis.
        design: ``[D]``.
        seconds: simulated time, at most an episode.
    """
    given = design.to(torch.float32)[None]
    observation = bodies.reset(TensorDict({"design": given}, [1]))["observation"]
    stride = max(1, round(1 / (FRAMES_PER_SECOND * bodies.step_seconds)))
    steps = min(bodies.episode_steps, math.ceil(seconds / bodies.step_seconds))
    frames, seen = [], []
    for step in range(steps):
        if step % stride == 0:
            frames.append(bodies.capsules()[:, :6].numpy())
        seen.append(observation)
        observation, _ = bodies.move(policy.deterministic_action(observation, given))
    chosen = np.linspace(0, steps - 1, min(steps, STATES)).astype(int)
    return Walk(np.stack(frames), torch.cat([seen[step] for step in chosen]), design)


def frame_seconds(bodies: MorphEnv) -> float:
    """Simulated time between two frames of a walk, in s."""
    return bodies.step_seconds * max(1, round(1 / (FRAMES_PER_SECOND * bodies.step_seconds)))


def _num_positions(bodies: MorphEnv) -> int:
    """Number of observed positions."""
    return bodies.observation_spec["observation"].shape[-1] - bodies.simulations.qvel.shape[1]
