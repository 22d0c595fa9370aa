"""Experiments with the library: runs on disk, their pages, studies, figures, and the command line.

Optional: ``pip install 'coim[experiments]'``. Nothing else in ``coim`` imports it."""
