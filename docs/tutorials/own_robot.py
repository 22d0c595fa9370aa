"""
Bring your own robot
====================

A robot that is drawn in an MJCF file becomes a body with `morph_from_mjcf`: it takes the file, a list of what
scales, and a reward. The robot may run in a plane, move freely, or stand on a fixed base. Its actuators must be
motors.
"""

# %%
# The file
# --------
#
# A crawler: a torso, and a leg with one motor at each end.

import tempfile
from pathlib import Path

CRAWLER = """
<mujoco model="crawler">
  <compiler angle="radian"/>
  <option timestep="0.005"/>
  <default>
    <geom density="1000" friction="1 0.1 0.1" condim="3" contype="1" conaffinity="0"/>
    <joint damping="2" armature="0.1"/>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="40 40 1" contype="0" conaffinity="1"/>
    <body name="torso" pos="0 0 0.6">
      <joint name="rootx" type="slide" axis="1 0 0" damping="0" armature="0"/>
      <joint name="rootz" type="slide" axis="0 0 1" damping="0" armature="0" ref="0.6"/>
      <joint name="rooty" type="hinge" axis="0 1 0" damping="0" armature="0"/>
      <geom name="torso" type="capsule" size="0.05" fromto="-0.4 0 0 0.4 0 0"/>
      <body name="back" pos="-0.4 0 0">
        <joint name="back" type="hinge" axis="0 1 0" range="-1 1" limited="true"/>
        <geom name="back" type="capsule" size="0.05" fromto="0 0 0 0 0 -0.5"/>
      </body>
      <body name="front" pos="0.4 0 0">
        <joint name="front" type="hinge" axis="0 1 0" range="-1 1" limited="true"/>
        <geom name="front" type="capsule" size="0.05" fromto="0 0 0 0 0 -0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="back" gear="100" ctrlrange="-1 1" ctrllimited="true"/>
    <motor joint="front" gear="100" ctrlrange="-1 1" ctrllimited="true"/>
  </actuator>
</mujoco>
"""
file = Path(tempfile.mkdtemp()) / "crawler.xml"
file.write_text(CRAWLER)

# %%
# The reward
# ----------
#
# The reward is a pure function of tensors. The simulator pays it, and so does the learnt model. An observation is all
# positions and velocities, without the place along x: here the height, the pitch, two hips, and then five velocities.

from torch import Tensor

SPEED = 4  # entry of the observation: velocity along x, m/s


def reward(observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor) -> Tensor:
    """Speed less a cost of the torques, ``[*B, 1]``."""
    return next_observation[..., SPEED, None] - 0.1 * action.square().mean(-1, keepdim=True)


# %%
# The body
# --------
#
# Each entry of the design has a name and the capsules whose length it scales. What hangs on a capsule moves with its
# end. Density stays, so mass follows length.

from coim import morph_from_mjcf

Crawler = morph_from_mjcf(
    file,
    scale={"torso": ["torso"], "back leg": ["back"], "front leg": ["front"]},
    reward=reward,
    bounds={"torso": (0.5, 1.5), "back leg": (0.5, 2.0), "front leg": (0.5, 2.0)},
)
print(Crawler.DESIGN_NAMES, Crawler.DESIGN_BOUNDS)

# %%
# TorchRL checks it, and the bodies that a run would try first are drawn:

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from coim.experiments.drawing.bodies import draw_capsule

env = Crawler(num_runs=5, episode_steps=50, seed=0, reset_noise=0.0)
check_env_specs(env)
env.reset(TensorDict({"design": torch.tensor(Crawler.FIRST_DESIGNS)}, [5]))

figure, axes = plt.subplots(figsize=(8, 2.5), layout="constrained")
for run in range(5):
    for x1, _, z1, x2, _, z2, radius in env.capsules(run).tolist():
        draw_capsule(axes, (x1 + 1.6 * run, z1), (x2 + 1.6 * run, z2), radius, "tab:blue")
axes.axhline(0, color="black", linewidth=0.8)
axes.set(aspect="equal", xticks=[], ylabel="height (m)")

# %%
# Co-adapt it
# -----------
#
# Everything else in ``coim`` takes the class as it takes the hopper: the losses, the ensemble, `CoAdaptation`, and
# ``run``.

from coim.experiments.run.settings import Settings
from coim.experiments.train import run as co_adapt

settings = Settings(
    imagine="none",
    num_designs=6,
    first_episodes=1,
    episodes=1,
    episode_steps=50,
    num_cells=(32, 32),
    individual_updates=20,
    population_updates=10,
    batch_size=64,
    search="gradient",
    threads=1,
    quiet=True,
    out=file.parent / "run",
)
folder = co_adapt(Crawler, "crawler", settings)
print((folder / "designs.csv").read_text())

# %%
# A class of your own
# -------------------
#
# Where lengths of capsules are not enough, write a subclass of `MorphEnv`. It says in Python which numbers of the
# file a design changes. ``recipes/new_body.py`` is such a class on two screens, for the same crawler.
#
# Assign a class to a variable of a module of your own, and ``coim report`` and ``coim watch`` take it by ``--body
# module:Class``.
