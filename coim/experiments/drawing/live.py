"""A robot that walks in the browser until it is told to end: ``coim watch --live``.

`mjviser <https://github.com/mujocolab/mjviser>`_ serves the page, which can pause, slow down, start again, turn the
camera, and show contacts and forces. Its sliders of joints and motors do not reach the robot, which its policy drives.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import ExplorationType, set_exploration_type

from coim.envs.window import Figure
from coim.experiments.export.taken import Taken, Which, take

HOST = "127.0.0.1"  # whoever is on another machine comes through ssh -L
EXTENT = 1.3  # m; the page's camera stands three times as far away


def live(source: Path, *, design: str, run: int | None, policy: Which | None, body: str | None, port: int) -> None:
    """Serve a page in which a policy drives its body, until Ctrl-C.

    Args:
        source: a run folder, or a file of ``coim export``.
        design: ``best``, the number of a design, or factors with commas between them.
        run: one of K runs; None takes the one with the best return.
        policy: that of the design's best evaluation or the population's.
        body: class of the body as module:Class, if it is none of ours.
        port: of this machine; the next free one is taken if it is not free.

    Raises:
        ImportError: if mjviser is not installed; the message says how to install it.
        ValueError: if there is no such run, design, policy, file or body.
    """
    try:
        import viser
        from mjviser import Viewer
    except ImportError as error:
        raise ImportError(f"--live shows a robot by mjviser ({error}); pip install 'coim[live]'") from None
    torch.set_num_threads(1)
    taken = take(source, design, run=run, policy=policy, body=body)
    walk = Walk(taken)
    server = viser.ViserServer(host=HOST, port=port, verbose=False)
    print(f"{taken.name}: http://{HOST}:{server.get_port()} in a browser; Ctrl-C ends it", flush=True)
    with suppress(KeyboardInterrupt):  # the viewer's loop ends by it, but not while the viewer is being made
        Viewer(walk.figure.model, walk.figure.data, step_fn=walk.step, reset_fn=walk.reset, server=server).run()


class Walk:
    """An episode without an end, a step at a time.

    Args:
        taken: policy and body.

    Attributes:
        figure: the body as it is shown; its time step is that of the environment.
    """

    def __init__(self, taken: Taken) -> None:
        self._policy, self._design = taken.policy, taken.design[None]
        self._bodies = taken.bodies(1, seed=0)
        self._observation = self._start()
        self.figure = Figure(self._bodies.simulations.body(taken.design.numpy()), root=self._bodies.root)
        self._physics_seconds = self.figure.model.opt.timestep
        self.figure.model.stat.extent = EXTENT
        self._show()

    def step(self, *_: Any) -> None:
        """Act once with the mode of the policy; a simulation that breaks starts again."""
        state = TensorDict({"observation": self._observation, "design": self._design}, [1])
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            action = self._policy(state)["action"]
        self._observation, broken = self._bodies.move(action)
        if broken.any():
            self._observation = self._start()
        self._show()

    def reset(self, *_: Any) -> None:
        """Start again."""
        self._observation = self._start()
        self._show()

    def _start(self) -> Tensor:
        state: TensorDictBase = self._bodies.reset(TensorDict({"design": self._design}, [1]))
        return state["observation"]

    def _show(self) -> None:
        simulations, options = self._bodies.simulations, self.figure.model.opt
        options.timestep = self._physics_seconds  # how stiff a contact is depends on it
        self.figure.pose(simulations.qpos[0], qvel=simulations.qvel[0], ctrl=simulations.ctrl[0])
        options.timestep = self._bodies.step_seconds  # the page's clock reads it
