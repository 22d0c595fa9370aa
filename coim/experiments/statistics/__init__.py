"""Intervals and measures over runs."""
