"""Walker, torso and six leg segments: the paper's protocol; ``python -m recipes.walker --help`` lists every setting."""

import sys

from coim.experiments.command import main

if __name__ == "__main__":
    sys.argv[1:1] = ["run", "walker"]
    main()
