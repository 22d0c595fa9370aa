"""Walker: one run of the paper's protocol, about a day on one core; ``--help`` lists every setting.

``python -m recipes.walker`` is the same as ``coim run walker``.

- Body: torso and two legs of three segments, each 0.5 to 2.0 times as long as Gymnasium's Walker has it.
- Reward per step: a tenth of forward speed plus 1 while the torso is above 0.8 m, less 0.1 times the pitch.
- Runs: the arms ``known``, ``noisy``, ``random`` and ``none`` (imagine nothing: the baseline), 15 seeds (Fig. 1).
- Protocol (Sec. 6.1), the default of every setting: five first bodies with 300 episodes each, the same for all runs;
  then 50 bodies with 100 episodes each, which maximise Eq. 5 or are drawn at random in turn. 1000 steps an episode;
  after each 1000 updates of the individual networks, 250 of the population's and 250 of the ensemble.

``coim study paper`` computes all arms and seeds, and `recipes.algorithm1` writes the algorithm out.
"""

import sys

from coim.experiments.command import main

if __name__ == "__main__":
    sys.argv[1:1] = ["run", "walker"]
    main()
