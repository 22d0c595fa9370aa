"""The ways of choosing bodies that are compared: `benchmarks.choosing` simulates studies of each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Arm:
    """A way to choose bodies.

    Attributes:
        name: in the tables.
        choose: "posterior" (its upper confidence bound), "improvement" (noisy expected improvement under it), "critic".
        critic: None; a made-up one, by its correlation with the truth over the design space; or Eq. 5 of trained
            networks over "stored" start states or "matched" visited ones.
        optimism: of the upper confidence bound.
        reach: of a trust region around the body with the best return so far; None: the whole space.
        widening: of the reach, with each body.
        explore: every second body: "random", or "uncertain" (where the posterior deviates most).
        spread, noise, length: constants of the priors where they are not the library's.
        designs: bodies of a study.
        surface: that it is tried on.
    """

    name: str
    choose: str = "posterior"
    critic: float | str | None = None
    optimism: float = 0.5
    reach: float | None = None
    widening: float = 0.0
    explore: str = "random"
    spread: float | None = None
    noise: float | None = None
    length: float | None = None
    designs: int = 15
    surface: str = "hopper"


def _arms() -> Iterator[Arm]:
    for critic in (None, "matched", 0.5, -0.45):
        yield Arm(name="posterior", critic=critic)
    for critic in ("matched", "stored", 0.5):
        yield Arm(name="critic alone", choose="critic", critic=critic)
    yield Arm(name="trust region of 0.25", reach=0.25)
    for critic in (None, "matched"):
        yield Arm(name="trust region of 0.25 that widens by 0.1", critic=critic, reach=0.25, widening=0.1)
    yield Arm(name="most uncertain exploration", explore="uncertain")
    yield Arm(name="noisy expected improvement", choose="improvement")
    yield Arm(name="spread of priors 1", spread=1.0)
    for optimism in (0.0, 1.5):
        yield Arm(name=f"optimism {optimism:g}", optimism=optimism)
    yield Arm(name="critic alone, trust region of 0.25", choose="critic", critic="matched", reach=0.25)
    yield Arm(name="posterior", surface="hartmann")
    yield Arm(name="posterior", critic=0.5, surface="hartmann")
    yield Arm(name="posterior", surface="hopper, a third of the noise")
    for noise in (0.5, 1.5):
        yield Arm(name=f"median of noise {noise:g}", noise=noise)
    for length in (0.4, 1.6):
        yield Arm(name=f"median of length {length:g}", length=length)
    yield Arm(name="posterior", designs=30)
    # What looked better than the default, with a critic and elsewhere.
    yield Arm(name="optimism 1.5", critic="matched", optimism=1.5)
    yield Arm(name="most uncertain exploration", critic="matched", explore="uncertain")
    yield Arm(name="most uncertain exploration", explore="uncertain", surface="hartmann")
    yield Arm(name="optimism 1.5", optimism=1.5, surface="hartmann")


ARMS = tuple(_arms())
