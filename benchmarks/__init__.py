"""What is fast, as ratios that are measured side by side in one run: ``python -m benchmarks``."""

from coim.experiments.command import mind_ctrl_c

mind_ctrl_c()  # while everything else is imported
