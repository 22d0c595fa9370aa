"""What is fast, as ratios that are measured side by side in one run: ``python -m benchmarks``."""

import recipes as recipes  # for Ctrl-C while everything else is imported
