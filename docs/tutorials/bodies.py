"""
One body, many lengths: the environment
=======================================

`HopperMorph` is an ordinary TorchRL environment with one more entry, ``design``. The design is a vector of factors:
a factor of 1 leaves a part as it was drawn, a factor of 2 makes it twice as long. Density is constant, so mass
follows length.
"""

# %%
# A fleet of bodies
# -----------------
#
# ``num_runs=3`` makes three robots that step together. Each row has a body of its own. The design enters at reset.

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict

from coim import HopperMorph
from coim.experiments.drawing.bodies import draw_capsule

env = HopperMorph(num_runs=3, episode_steps=100, seed=0)
print(env.design_names())

designs = torch.tensor([[1.0, 1.0, 1.0, 1.0], [0.8, 1.2, 1.1, 1.5], [1.5, 0.6, 0.9, 2.0]])
start = env.reset(TensorDict({"design": designs}, [3]))
print(start)

# %%
# The three bodies from the side, as they start:

figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
for run, colour in enumerate(("tab:blue", "tab:orange", "tab:green")):
    for x1, _, z1, x2, _, z2, radius in env.capsules(run).tolist():
        draw_capsule(axes, (x1 + 1.5 * run, z1), (x2 + 1.5 * run, z2), radius, colour)
axes.axhline(0, color="black", linewidth=0.8)
axes.set(aspect="equal", xlabel="m", ylabel="height (m)")

# %%
# A body stays until the next reset
# ---------------------------------
#
# A rollout carries the design in every row, under ``next`` too. So a replay buffer of many bodies needs nothing else,
# and losses of TorchRL run on its rows unchanged. Only a reset changes a body.

rows = env.rollout(20, auto_reset=False, tensordict=start)
print(rows["next", "reward"].shape, rows["design"][:, 0].tolist())

# %%
# What can be built
# -----------------
#
# ``design_spec`` has the bounds. It draws designs, and it clips a design to the bounds. A design outside of them is
# refused with a sentence that says what to do.

spec = env.design_spec
print(spec.rand())
print(spec.project(torch.tensor([1.0, 3.0, 1.0, 0.1])))
try:
    env.reset(TensorDict({"design": 3 * designs}, [3]))
except ValueError as error:
    print(error)

# %%
# Another body in each episode
# ----------------------------
#
# A transform of TorchRL draws a body before each reset. With it, a collector sees many bodies without a line of code
# about them.

from torchrl.envs import TensorDictPrimer, TransformedEnv

one = HopperMorph(episode_steps=10, seed=1)
draw_body = TensorDictPrimer(one.state_spec, random=True, call_before_env_reset=True)
many = TransformedEnv(one, draw_body)
for _ in range(3):
    print(many.rollout(10)["design"][0, 0].tolist())

# %%
# The reward is known
# -------------------
#
# Each body has its reward as a pure function. The real environment pays it, and so does the learnt one in
# :doc:`ensemble`.

row = rows[0, 0]
again = HopperMorph.reward(row["observation"], row["action"], row["next", "observation"], row["design"])
print(torch.equal(again, row["next", "reward"]))

# %%
# In Gymnasium
# ------------
#
# The same bodies have Gymnasium's interface. An observation then ends with the design.

import gymnasium

single = gymnasium.make("coim/Hopper-v0", design=[1.0, 1.5, 0.5, 1.0], max_episode_steps=100)
observation, info = single.reset(seed=0)
print(observation.shape, info["design"])
_, info = single.reset(options={"design": [1.0, 1.0, 0.5, 2.0]})
print(info["design"])
