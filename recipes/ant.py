"""Ant, a robot that is not in the paper: one run of the paper's protocol; ``--help`` lists every setting.

``python -m recipes.ant`` is the same as ``coim run ant``.

- Body: eight leg segments, each 0.5 to 1.5 times as long as Gymnasium's Ant has it. It moves freely through space.
- Reward per step: the speed along x in m/s, 1 for a torso between 0.2 and 1.0 m, less half of the actions' squares.
- A first look: ``coim run ant --preset quick``.
"""

import sys

from coim.experiments.command import main

if __name__ == "__main__":
    sys.argv[1:1] = ["run", "ant"]
    main()
