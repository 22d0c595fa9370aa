"""What `make gpu` lacks on this machine, before anything is installed: no imports but Python's own and torch."""

from __future__ import annotations

import sys


def missing() -> str | None:
    """One sentence on why nothing can be measured on a GPU here; None if it can."""
    try:
        import torch
    except ImportError as error:
        return f"make gpu needs a torch with CUDA, and {sys.executable} has none ({error}); try make gpu PYTHON=..."
    if torch.version.cuda is None:
        return f"make gpu needs a GPU of NVIDIA, and torch {torch.__version__} is built without CUDA; try PYTHON=..."
    if not torch.cuda.is_available():
        return f"make gpu needs a GPU of NVIDIA, and torch {torch.__version__} sees none; is there one, with a driver?"
    return None


if __name__ == "__main__":
    sys.exit(missing())
