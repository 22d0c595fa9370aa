"""``python -m coim.experiments`` is the command ``coim``."""

from coim.experiments.command import main

if __name__ == "__main__":
    main()
