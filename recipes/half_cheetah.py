"""Half-Cheetah: six leg segments; ``python -m recipes.half_cheetah --help`` lists every setting."""

from coim import HalfCheetahMorph
from recipes.experiment import main

if __name__ == "__main__":
    main(HalfCheetahMorph, "half_cheetah")
