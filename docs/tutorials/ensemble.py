"""
The ensemble as an environment
==============================

An ensemble of networks learns how all bodies move. `WorldModelEnv` makes an environment of it, with the body's own
reward. It can be stepped under designs that were never built.
"""

# %%
# Learn from a few episodes
# -------------------------
#
# Eight random bodies act at random for 100 steps. The last two are kept aside. `DynamicsLearner` is the loss of the
# ensemble (Eq. 6) with its optimiser.

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDict

from coim import (
    DynamicsLearner,
    GaussianEnsemble,
    HopperMorph,
    NoisyDesigns,
    TransitionBuffer,
    WorldModelEnv,
    imagine,
    make_policy,
    run_episode,
    sample_batches,
)

torch.manual_seed(0)
env = HopperMorph(num_runs=8, episode_steps=100, seed=0)
rng = torch.Generator().manual_seed(0)
episodes = run_episode(env, None, design=env.design_spec.rand([8]), rng=rng)  # [T, K]
known, unknown = episodes[:, :6].reshape(-1), episodes[:, 6:].reshape(-1)
print(known.batch_size, unknown.batch_size)

# %%
# How well are bodies predicted that the model has not seen? The unit of the error is the variance of a one-step
# change. A model that predicts no change at all has an error of about 1.

ensemble = GaussianEnsemble.for_env(env, num_members=3, num_cells=(64, 64))
learner = DynamicsLearner(ensemble, lr=1e-3)
buffer = TransitionBuffer(len(known), seed=0)
buffer.extend(known.unsqueeze(-1))  # [T, K], here of one run
learner.observe(known)  # means and deviations by which inputs and targets are scaled

curve = []
for _ in range(10):
    learner.update(sample_batches(buffer, batch_size=128, num_batches=30, rng=rng))
    curve.append((learner.error(known).item(), learner.error(unknown).item()))

figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
axes.plot(range(30, 301, 30), curve, label=["bodies it learnt from", "other bodies"])
axes.set(xlabel="update", ylabel="error", ylim=(0, None))
axes.legend()

# %%
# Step the model
# --------------
#
# The start states come from the rows, the designs are new. No simulator is asked.

dream = WorldModelEnv(ensemble, env, batch_size=[50], seed=0)
start = TensorDict({"observation": known["observation"][:50], "design": env.design_spec.rand([50])}, [50])
imagined = dream.rollout(5, auto_reset=False, tensordict=dream.reset(start))
print(imagined["next", "reward"].shape)

# %%
# What the algorithm asks for
# ---------------------------
#
# `imagine` takes one step from each of many states, under designs that a generator draws. ``states_are="matched"``
# moves the robot up or down, so that it stands as high above the floor as before. With stored states, as in the
# paper, a longer leg may be in the floor, and the model knows nothing about that.

policy = make_policy(env, num_cells=(32,))
rows = imagine(dream, known[:200], policy, NoisyDesigns(env.design_spec, sigma=0.1), states_are="matched", rng=rng)
print(rows.batch_size, rows["next", "reward"].mean().item())
