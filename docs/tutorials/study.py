"""
A study, its statistics, and what you may claim
===============================================

One run of co-adaptation proves nothing: another seed may tell the opposite. A *study* is many runs that are
compared under one protocol. This tutorial defines a study, reads a real one, and says which sentences its numbers
allow.
"""

# %%
# Define a study
# --------------
#
# A study is environments x tasks x arms x seeds. An *arm* is one way of doing it. The arms of a seed share the first
# bodies, the random bodies, the first weights and the noise of the starts, so that runs can be compared in pairs.

import json

from coim.experiments.study.definition import Study

study = Study(
    name="mine",
    environments=("hopper",),
    arms=("none", "known"),
    seeds=tuple(range(10)),
    protocol="preview",
)
print(len(study.cells()), "cells, such as", study.cells()[0].name)
print(json.dumps({"name": "mine", "environments": ["hopper"], "arms": ["none", "known"], "seeds": [0, 1, 2]}))

# %%
# The last line is such a study as a file. One command makes all of its runs, and goes on after a stop::
#
#     coim study mine.json --workers 2
#     coim figures runs/study-mine

# %%
# Read a study
# ------------
#
# The preview study lies in the repository, in ``docs/results/preview``. Run this script from a checkout.

from pathlib import Path

import coim
from coim.experiments.statistics.measures import comparisons, measures
from coim.experiments.statistics.retrained import with_retrained
from coim.experiments.study.runs import read_runs

folder = Path(coim.__file__).parents[1] / "docs" / "results" / "preview"
runs = read_runs(folder)
measured = with_retrained(measures(runs), folder)
hopper = measured[measured["environment"] == "hopper"]
print(hopper.groupby("arm")[["area", "final", "retrained", "search_gain"]].agg(["mean", "std"]).round(0))

# %%
# ``area`` is the mean best return over all bodies of a run: how fast it learns. ``final`` is the best return of all
# bodies: what is in hand at the end. Each point below is a run.

import matplotlib.pyplot as plt

figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
for place, (_, of_arm) in enumerate(hopper.groupby("arm")):
    axes.plot(of_arm["area"], [place] * len(of_arm), "o", alpha=0.6)
    axes.plot(of_arm["area"].mean(), place, "k|", markersize=18)
axes.set(xlabel="area", yticks=range(4), yticklabels=sorted(set(hopper["arm"])))

# %%
# Compare two arms
# ----------------

table = comparisons(runs, measured)
known = table[(table["environment"] == "hopper") & (table["arm"] == "known") & (table["against"] == "none")]
columns = [
    "measure",
    "runs",
    "difference",
    "difference_low",
    "difference_high",
    "welch_p",
    "welch_p_holm",
    "detectable",
]
print(known[columns].round(2).to_string(index=False))

# %%
# What you may claim
# ------------------
#
# - *The interval holds 0.* Then nothing is shown, in either direction. Do not write that two arms are equal.
# - *Look at* ``detectable`` *first.* It is the difference that this study would find in four of five repetitions. A
#   study that can only see large differences cannot show a small advantage, nor its absence. More seeds help; longer
#   tables do not.
# - *Correct for the number of tests.* ``welch_p_holm`` is Holm's correction over all pairs of arms of a measure.
# - *Few runs make intervals too narrow.* With five runs, a 95 % bootstrap interval of the mean holds the truth in 84
#   % of studies, with three in 76 %.
# - *Choose the measure before the runs.* A maximum over many bodies, such as ``final``, is noisier than a mean.
# - *Develop on some seeds, confirm on others.* The named studies ``bodies-develop`` and ``bodies`` do so.
# - *A run that diverges counts.* It gets the lowest return of its environment on the bodies that it did not reach. To
#   leave it out would flatter its arm.
#
# The page of :doc:`the preview study </results/preview>` is written by these rules.
