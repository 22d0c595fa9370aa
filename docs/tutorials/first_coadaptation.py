"""
Your first co-adaptation
========================

A robot's body and its controller are improved together. The body is a *design*: a few numbers that scale its parts.
The algorithm trains a controller on one body after the other, learns from all of them, and chooses the next body.

This tutorial makes a tiny run of the hopper, with seven bodies and one episode of 50 steps on each. It takes
seconds and learns almost nothing. The same code with the paper's numbers takes a day.
"""

# %%
# The run
# -------
#
# On the command line, a first look is one line and takes about five minutes::
#
#     coim run hopper --preset quick
#
# The command is a thin layer over two names: ``Settings`` has every number of a run, and ``run`` makes the run. Each
# setting has the paper's value as its default.

import tempfile
from pathlib import Path

from coim import HopperMorph
from coim.experiments.run.settings import Settings
from coim.experiments.train import run

settings = Settings(
    num_designs=7,
    first_episodes=1,
    episodes=1,
    episode_steps=50,
    num_cells=(32, 32),
    model_cells=(32,),
    individual_updates=20,
    population_updates=10,
    model_updates=10,
    batch_size=64,
    search="gradient",
    threads=1,
    quiet=True,
    out=Path(tempfile.mkdtemp()) / "first",
)
folder = run(HopperMorph, "hopper", settings)
print(*sorted(path.name for path in folder.glob("[a-z]*")), sep="\n")

# %%
# What was tried
# --------------
#
# ``designs.csv`` has a row for each body. The first five are fixed. After them, the body that maximises the critic's
# value and a random body take turns. ``predicted`` is what the critic expected before the body was built, and
# ``best_return`` is what was earned on it.

import pandas as pd

designs = pd.read_csv(folder / "designs.csv")
print(designs.drop(columns=["run", "diverged"]).round(2).to_string(index=False))

# %%
# The bodies themselves, from left to right in the order in which they were built. The numbers below each body are its
# place in that order and its best return. The colours tell first, optimised and random bodies apart.

import matplotlib.pyplot as plt

from coim.experiments.drawing.bodies import draw_bodies

figure, axes = plt.subplots(figsize=(8, 3), layout="constrained")
draw_bodies(axes, designs, HopperMorph)

# %%
# What to read next
# -----------------
#
# - ``report.html`` in the folder shows the whole run on one page. :doc:`watching` opens a run in Python and films it.
# - :doc:`choosing` is about the choice of the next body.
# - A single run proves nothing: see :doc:`study`.
