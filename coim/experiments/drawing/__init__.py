"""Colours, layouts, drawn bodies and films."""
