"""Walker: torso and six leg segments; ``python -m recipes.walker --help`` lists every setting."""

from coim import WalkerMorph
from recipes.experiment import main

if __name__ == "__main__":
    main(WalkerMorph, "walker")
