"""Half-Cheetah, six leg segments: the paper's protocol; ``python -m recipes.half_cheetah --help`` lists settings."""

import sys

from coim.experiments.command import main

if __name__ == "__main__":
    sys.argv[1:1] = ["run", "half_cheetah"]
    main()
