"""Figures of a study, one file per argument; each has ``plots(study)``, which `recipes.figures` goes over."""
