"""Half-Cheetah: one run of the paper's protocol, about a day on one core; ``--help`` lists every setting.

``python -m recipes.half_cheetah`` is the same as ``coim run half_cheetah``.

- Body: six leg segments, each 0.8 to 2.0 times as long as Gymnasium's Half-Cheetah has it.
- Reward per step: the speed in m/s over 10, clipped to [0, 10].
- Runs: the arms ``known``, ``noisy``, ``random`` and ``none`` (imagine nothing: the baseline), 30 seeds (Fig. 1).
- Protocol (Sec. 6.1), the default of every setting: five first bodies with 300 episodes each, the same for all runs;
  then 50 bodies with 100 episodes each, which maximise Eq. 5 or are drawn at random in turn. 1000 steps an episode;
  after each 1000 updates of the individual networks, 250 of the population's and 250 of the ensemble.

``coim study paper`` computes all arms and seeds, and `recipes.algorithm1` writes the algorithm out.
"""

import sys

from coim.experiments.command import main

if __name__ == "__main__":
    sys.argv[1:1] = ["run", "half_cheetah"]
    main()
