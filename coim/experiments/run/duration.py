"""Times in words."""

from __future__ import annotations


def in_words(seconds: float) -> str:
    """A time as one would say it."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 90 * 60 else f"{seconds / 3600:.{seconds < 36000:d}f} h"
