"""A policy taken out of a run: evaluated on its body, and written for other programs."""
