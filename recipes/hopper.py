"""Hopper: four segments; ``python -m recipes.hopper --help`` lists every setting."""

from coim import HopperMorph
from recipes.experiment import main

if __name__ == "__main__":
    main(HopperMorph, "hopper")
