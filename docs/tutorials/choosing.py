"""
Choosing a body
===============

A *fitness* says what a design is worth, and a *search* maximises it. This tutorial shows the two kinds of fitness
that ``coim`` has: what the critics expect, and what the bodies built so far have earned.
"""

# %%
# What the critics expect
# -----------------------
#
# `DesignValue` is Eq. 5 of the paper: the mean over start states of the smallest critic's value. It maps designs
# ``[P, D]`` to values ``[P]``. The networks here are untrained, so the value means nothing yet.

import matplotlib.pyplot as plt
import torch

from coim import (
    DesignPosterior,
    DesignValue,
    GradientSearch,
    HopperMorph,
    ParticleSwarm,
    TrustRegion,
    make_policy,
    make_qvalue,
)

torch.manual_seed(0)
env = HopperMorph(num_runs=36, seed=0)
spec = env.design_spec
fitness = DesignValue(make_policy(env, num_cells=(32,)), make_qvalue(env, num_cells=(32,)), env.reset())
print(fitness(spec.rand([3])))

# %%
# Two searches
# ------------
#
# The particle swarm is the paper's. Gradient ascent from many starts finds the same optimum sooner.

for search in (ParticleSwarm(spec, num_particles=50, num_iterations=20, seed=0), GradientSearch(spec, seed=0)):
    design, value = search.maximise(fitness)
    print(type(search).__name__, [round(xi, 2) for xi in design.tolist()], round(value, 4))

# %%
# What the bodies have earned
# ---------------------------
#
# Critics may rank bodies badly. `DesignPosterior` is a Gaussian process over the returns of the bodies built so far.
# It predicts the return of any other body, and how sure that is. With ``prior=`` it listens to a critic as far as the
# critic agrees with the returns. It needs the extra ``posterior``.

designs = torch.tensor(
    [[1.0, 1.0, 1.0, 1.0], [0.5, 0.8, 1.9, 0.7], [1.9, 1.3, 1.9, 0.6], [0.6, 1.5, 1.6, 1.3], [0.9, 0.9, 0.6, 1.8]]
)
returns = torch.tensor([954.1, 1402.0, 790.5, 1449.6, 1010.0])
posterior = DesignPosterior(spec, designs, returns)

# %%
# A cut through the first body: only the torso's factor changes. The band is one deviation to each side, noise
# included.

torso = torch.linspace(0.5, 2.0, 40)
line = torch.ones(40, 4)
line[:, 0] = torso
mean, deviation = posterior.predict(line)
figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
axes.plot(torso, mean)
axes.fill_between(torso, mean - deviation, mean + deviation, alpha=0.3)
axes.set(xlabel="factor of the torso", ylabel="return expected")

# %%
# The posterior is a fitness too, the upper end of what a body may earn. `TrustRegion` keeps a search near a body that
# is known to be good: here at most a fifth of each range away from the best one.

best = designs[returns.argmax()]
design, _ = TrustRegion(spec, GradientSearch(spec, seed=0), reach=0.2).maximise(posterior, centre=best)
mean, deviation = posterior.predict(design[None])
print([round(xi, 2) for xi in design.tolist()], f"{mean.item():.0f} +- {deviation.item():.0f}")

# %%
# In a run
# --------
#
# ``coim run hopper --method returns`` chooses bodies by the posterior, ``--method grounded`` with a critic as its mean
# that is checked against what was earned. `PosteriorChoice` is the part of Algorithm 1 that does so. A search of your
# own is a class with one method: see ``recipes/new_search.py``.
