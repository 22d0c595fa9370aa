"""Algorithm 1 of the paper, written out from the parts of `coim`: copy this file and change it.

`coim.CoAdaptation` is the same algorithm with checks, checkpoints and several seeds side by side; this is one seed and
nothing else, and computes the same numbers. The defaults are the paper's protocol (Sec. 6.1), about a day of computing.
For a first look, about ten minutes::

    python -m recipes.algorithm1 --num-designs 8 --first-episodes 4 --episodes 4 --num-particles 100

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Algorithm 1, Eq. 3-8, Sec. 5 and 6.1.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torchrl.data import Bounded

from coim import (
    Buffers,
    DesignSearch,
    DesignValue,
    DynamicsLearner,
    GaussianEnsemble,
    HopperMorph,
    KnownDesigns,
    MorphEnv,
    ParticleSwarm,
    RandomDesigns,
    SACLearner,
    WorldModelEnv,
    imagine,
    make_policy,
    make_qvalue,
    run_episode,
    sample_batches,
    sample_mixture,
)


def main(
    body: type[MorphEnv] = HopperMorph,
    *,
    make_search: Callable[[Bounded], DesignSearch] | None = None,  # from the bounds of a design; None: a swarm
    num_designs: int = 55,  # M, bodies that are tried, the first ones included
    first_episodes: int = 300,  # on each of the body's FIRST_DESIGNS
    episodes: int = 100,  # on each later design
    episode_steps: int = 1000,  # T
    individual_updates: int = 1000,  # after each episode
    population_updates: int = 250,  # after each episode
    model_updates: int = 250,  # after each episode
    batch_size: int = 256,
    imagined_share: float = 0.2,  # of a population batch; 0 is the model-free baseline, in which nothing reads p~
    num_cells: tuple[int, ...] = (200, 200, 200),  # hidden units of the policy and of each critic
    model_cells: tuple[int, ...] = (500, 500, 500),  # hidden units of each member of the ensemble
    num_particles: int = 700,
    num_iterations: int = 250,
    num_start_states: int = 36,  # n of Eq. 5
    seed: int = 0,
) -> list[float]:
    """Improve a body and its controller together; returns the best evaluation return on each design."""
    # -- environments, networks with their losses and optimisers, buffers ---------------------------------------------
    torch.manual_seed(seed)  # initial weights
    env, evaluation_env = (body(episode_steps=episode_steps, seed=seed + offset) for offset in (0, 1))
    population, individual = (  # Eq. 7-8, which are Eq. 3-4 where no row is imagined
        SACLearner(
            make_policy(env, num_cells=num_cells),
            make_qvalue(env, num_critics=2, num_cells=num_cells),
            alpha=0.01,
            gamma=0.99,
            tau=0.005,
            lr=3e-4,
            seed=seed + offset,
        )
        for offset in (0, 1)
    )
    ensemble = GaussianEnsemble.for_env(env, num_members=3, num_cells=model_cells)  # p~
    dynamics = DynamicsLearner(ensemble, lr=3e-4, weight_decay=1e-5)  # Eq. 6
    dream = WorldModelEnv(ensemble, env, batch_size=env.batch_size)
    generator = KnownDesigns()  # G; or NoisyDesigns(env.design_spec, sigma=0.1), RandomDesigns(env.design_spec)
    search = ParticleSwarm(env.design_spec, num_particles=num_particles, num_iterations=num_iterations, seed=seed)
    if make_search is not None:
        search = make_search(env.design_spec)
    explore = RandomDesigns(env.design_spec)

    first_designs = torch.tensor(body.FIRST_DESIGNS)[:num_designs]
    counts = [first_episodes] * len(first_designs) + [episodes] * (num_designs - len(first_designs))
    imagined_rows = round(batch_size * imagined_share)
    buffers = Buffers.for_env(
        env,
        pop_capacity=sum(counts) * episode_steps,
        ind_capacity=max(counts) * episode_steps,
        s0_capacity=sum(counts),
        art_capacity=max(1, population_updates * imagined_rows),
        seed=seed,
    )
    # A generator for each thing that is random: leaving one out does not change the numbers of the others.
    seeds = torch.Generator().manual_seed(seed)
    actions_rng, dream_rng, design_rng, individual_rng, population_rng, model_rng = (
        torch.Generator().manual_seed(int(torch.randint(2**62, (), generator=seeds))) for _ in range(6)
    )

    def refresh_imagined() -> None:
        """Replace Replay_Art: states of Replay_Pop, designs of G, actions of pi_Pop, next states of p~."""
        buffers.art.empty()
        if imagined_rows > 0 and len(buffers.pop) > 0:
            states = buffers.pop.sample(buffers.art.capacity)
            buffers.art.extend(imagine(dream, states, population.policy, generator, rng=dream_rng))

    best_returns: list[float] = []
    for i, count in enumerate(counts):
        # -- the second loop: after the first designs, the optimum of Eq. 5 and a random design in turn ---------------
        expected = "no start state yet"
        if i > 0:
            start_states = buffers.s0.sample(num_start_states)[:, 0]
            design_value = DesignValue(population.policy, population.qvalue, start_states)  # Eq. 5
        if i < len(first_designs):
            design = first_designs[i]
        elif (i - len(first_designs)) % 2 == 0:
            design, _ = search.maximise(design_value)
        else:
            design = explore(design, rng=design_rng)
        if i > 0:
            expected = f"Eq. 5 is {design_value(design[None]).item():.3f}"
        print(f"design {i}: {[round(xi, 3) for xi in design.tolist()]}, {expected}")

        # -- the first loop: behaviour and networks on this design ----------------------------------------------------
        individual.start_from(population)
        buffers.ind.empty()
        refresh_imagined()
        best = -torch.inf
        for episode in range(count):
            # Collect experience with pi_Ind.
            rows = run_episode(env, individual.policy, design=design[None], rng=actions_rng)
            buffers.ind.extend(rows)
            buffers.pop.extend(rows)
            buffers.s0.extend(rows[:1])
            # Refresh Replay_Art with p~ and pi_Pop.
            dynamics.observe(rows)  # running means and deviations, which scale what the ensemble reads and predicts
            refresh_imagined()
            # Train pi_Ind and Q_Ind on Replay_Ind.
            batches = sample_batches(
                buffers.ind, batch_size=batch_size, num_batches=individual_updates, rng=individual_rng
            )
            individual.update(batches)
            # Train pi_Pop and Q_Pop on Replay_Pop and Replay_Art.
            sources = ((buffers.pop, batch_size - imagined_rows), (buffers.art, imagined_rows))
            batches = sample_mixture(sources, population_updates, imagined=buffers.art, rng=population_rng)
            population.update(batches)
            # Train p~ on Replay_Pop.
            batches = sample_batches(buffers.pop, batch_size=batch_size, num_batches=model_updates, rng=model_rng)
            dynamics.update(batches)
            # Evaluate pi_Ind without noise; nothing of it is stored.
            rows = run_episode(evaluation_env, individual.policy, design=design[None], deterministic=True)
            achieved = rows["next", "reward"].sum().item()
            best = max(best, achieved)
            print(f"design {i}, episode {episode}: return {achieved:.2f}, best {best:.2f}")
        best_returns.append(best)
    return best_returns


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
