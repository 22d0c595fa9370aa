"""How large and how often: the paper's sizes (Sec. 6.1) and enough repeats, or less of both."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Effort:
    """Sizes and repeats of all rows; the defaults are those of the table that is published."""

    repeats: int = 9
    """Repeats of rows that take seconds."""
    long_repeats: int = 3
    """Repeats of rows that take half a minute."""
    threads: tuple[int, ...] = (1, 2)
    """Threads of the updates and the products."""
    runs: tuple[int, ...] = (1, 4, 16)
    """K, runs that one learner updates."""
    fleets: tuple[int, ...] = (1, 16, 64)
    """K, bodies that step together."""
    together: int = 8
    """K, runs with small networks that one learner updates."""

    # -- updates and imagination --------------------------------------------------------------------------------------
    batch_size: int = 256
    """Rows of a batch."""
    num_cells: tuple[int, ...] = (200, 200, 200)
    """Hidden units of policy and critics."""
    model_cells: tuple[int, ...] = (500, 500, 500)
    """Hidden units of each member of the ensemble."""
    updates: int = 48
    """Updates in one repeat, over all runs."""
    imagined_rows: int = 100_000
    """Rows imagined in one repeat."""

    # -- design search ------------------------------------------------------------------------------------------------
    num_particles: int = 700
    """Particles of the swarm."""
    num_iterations: int = 250
    """Iterations of the swarm."""
    num_start_states: int = 36
    """Start states that Eq. 5 averages over."""
    searched: tuple[str, ...] = ("half_cheetah", "hopper")
    """Bodies on whose trained networks designs are searched."""

    # -- whole iterations, bodies, memory -----------------------------------------------------------------------------
    individual_updates: int = 1000
    """Updates of the individual networks in one iteration of Algorithm 1."""
    population_updates: int = 250
    """Updates of the population networks in one iteration of Algorithm 1."""
    model_updates: int = 250
    """Updates of the ensemble in one iteration of Algorithm 1."""
    episode_steps: int = 1000
    """Steps of an episode in one iteration of Algorithm 1, and of a single body that steps with its policy."""
    fleet_steps: int = 400
    """Steps of an episode of several bodies."""
    replay_rows: int = 6_500_000
    """Half-Cheetah rows in Replay_Pop at the end of the paper's protocol."""


FULL = Effort()
SMALL = (64, 64, 64)  # hidden units of policy and critics in the protocol "pilot"

QUICK = Effort(
    repeats=3,
    long_repeats=1,
    runs=(1, 4),
    fleets=(1, 16),
    updates=16,
    imagined_rows=30_000,
    num_iterations=25,
    searched=("half_cheetah",),
    individual_updates=100,
    population_updates=25,
    model_updates=25,
    fleet_steps=100,
)
