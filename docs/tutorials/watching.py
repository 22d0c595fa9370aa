"""
Reading and filming a run
=========================

A run leaves a folder. This tutorial opens one in Python, lets its best body walk once more, and draws it. First it
makes a tiny run, which learns almost nothing.
"""

import tempfile
from pathlib import Path

from coim import HopperMorph
from coim.experiments.run.settings import Settings
from coim.experiments.train import run

settings = Settings(
    imagine="none",
    num_designs=2,
    first_episodes=1,
    episodes=1,
    episode_steps=100,
    num_cells=(32, 32),
    individual_updates=20,
    population_updates=10,
    batch_size=64,
    search="gradient",
    threads=1,
    quiet=True,
    out=Path(tempfile.mkdtemp()) / "watched",
)
folder = run(HopperMorph, "hopper", settings)

# %%
# Open it
# -------
#
# `load_run` reads the networks of the last checkpoint and the table of bodies. It changes nothing in the folder, and
# works while the run is still going on.

from coim import load_run, run_episode

loaded = load_run(folder)
best = loaded.best.tried
print(f"body {best.number}, {best.kind}:", dict(zip(loaded.bodies.design_names(), best.design.tolist())))
print("best return", round(best.best_return, 3))

# %%
# Let it walk once more
# ---------------------
#
# ``best_episode`` repeats the evaluation that gave a body its best return, with the same start and the same policy.
# The population's policy drives any body, also one that was never built.

rows = loaded.best_episode(best.number)
print("the same return", round(rows["next", "reward"].sum().item(), 3))
other = run_episode(
    loaded.bodies, loaded.population.policy, design=loaded.bodies.design_spec.rand([1]), deterministic=True
)
print("another body", round(other["next", "reward"].sum().item(), 3))

# %%
# Curves
# ------
#
# Rows are tensordicts ``[T, K]``. The table in the docstring of `HopperMorph` says what each entry of the observation
# is.

import matplotlib.pyplot as plt

seconds = [loaded.bodies.step_seconds * step for step in range(len(rows))]
figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
axes.plot(seconds, rows["observation"][:, 0, 0], label="height (m)")
axes.plot(seconds, rows["observation"][:, 0, 1], label="pitch (rad)")
axes.set(xlabel="time (s)")
axes.legend()

# %%
# Pictures
# --------
#
# ``render`` draws a body as it stands now. It needs OpenGL, but no screen.

loaded.bodies.reset()
try:
    picture = loaded.bodies.render(width=480, height=360)
except RuntimeError as missing:
    print(missing)
else:
    figure, axes = plt.subplots(figsize=(6, 4.5), layout="constrained")
    axes.imshow(picture)
    axes.axis("off")
# sphinx_gallery_thumbnail_number = -1

# %%
# Films and pages
# ---------------
#
# On the command line::
#
#     coim watch runs/A --design best      # an mp4 of the best evaluation
#     coim watch runs/A --design top5      # five bodies side by side
#     coim report runs/A                   # report.html, also while the run is going on
#     coim report runs/A runs/B            # two runs on one page
#
# To take a policy away::
#
#     coim evaluate runs/A --design best --episodes 20     # its return and spread, from other starts
#     coim export runs/A --design best --to policy.onnx    # for other programs, with the body beside it
