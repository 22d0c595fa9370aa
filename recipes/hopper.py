"""Hopper, four segments: the paper's protocol; ``python -m recipes.hopper --help`` lists every setting."""

import sys

from coim.experiments.command import main

if __name__ == "__main__":
    sys.argv[1:1] = ["run", "hopper"]
    main()
