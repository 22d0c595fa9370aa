"""Algorithm 1 on hoppers, small enough for a test."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import torch

from coim import (
    Buffers,
    CoAdaptation,
    DesignChoice,
    DynamicsLearner,
    GaussianEnsemble,
    Governor,
    HopperMorph,
    ImaginedReplay,
    KnownDesigns,
    NoisyDesigns,
    ParticleSwarm,
    SACLearner,
    UpdatePlan,
    WorldModelEnv,
    make_policy,
    make_qvalue,
)

STEPS = 12


def dealt(settings: Mapping[str, Any], *makers: Callable[..., Any]) -> list[dict[str, Any]]:
    """Deal out keywords to those that take them, one that several take to each of them."""
    hands = [{k: v for k, v in settings.items() if k in inspect.signature(make).parameters} for make in makers]
    assert {*settings} == {key for hand in hands for key in hand}
    return hands


def small(
    num_runs: int = 1,
    *,
    imagine: bool = True,
    governed: bool = False,
    sigma: float | None = None,
    device: str = "cpu",
    replay: str | None = None,
    **settings: Any,
) -> CoAdaptation:
    """Algorithm 1 on hoppers with tiny networks, few steps and few updates; the replay is where the networks are."""
    torch.manual_seed(0)
    stacked = num_runs if num_runs > 1 else None
    env, evaluation_env = (
        HopperMorph(num_runs=num_runs, episode_steps=STEPS, seed=seed, device=device) for seed in (0, 1)
    )

    def learner(seed: int) -> SACLearner:
        policy = make_policy(env, num_cells=(8,), num_runs=stacked).to(device)
        qvalue = make_qvalue(env, num_cells=(8,), num_runs=stacked).to(device)
        return SACLearner(policy, qvalue, num_runs=stacked, seed=seed)

    population, individual = learner(1), learner(2)  # before the ensemble: the same weights with and without one
    choosing, learning, imagining, rest = dealt(settings, DesignChoice, UpdatePlan, ImaginedReplay, CoAdaptation)
    capacities = {"pop_capacity": 200, "ind_capacity": 50, "s0_capacity": 20, "art_capacity": 50}
    buffers = Buffers.for_env(env, **capacities, seed=0, device=replay or device)
    imagination: dict[str, Any] = {}
    if imagine:
        ensemble = GaussianEnsemble.for_env(env, num_cells=(8,), num_runs=stacked).to(device)
        dream: dict[str, Any] = {
            "dream": WorldModelEnv(ensemble, env, batch_size=env.batch_size),
            "generator": KnownDesigns() if sigma is None else NoisyDesigns(env.design_spec, sigma=sigma),
            "governor": Governor(ensemble) if governed else None,
        }
        imagination["dynamics"] = DynamicsLearner(ensemble, num_runs=stacked)
        imagination["imagined"] = ImaginedReplay(buffers.art, **dream | imagining)
    chosen: dict[str, Any] = {
        "search": ParticleSwarm(env.design_spec, num_particles=5, num_iterations=2, seed=0),
        "first_designs": torch.tensor(HopperMorph.FIRST_DESIGNS[:2], device=device),
        "num_start_states": 4,
    }
    learnt = {"individual_updates": 3, "population_updates": 2, "model_updates": 2, "batch_size": 10}
    counts: dict[str, Any] = {"num_designs": 5, "first_episodes": 2, "episodes": 1}
    return CoAdaptation(
        env,
        evaluation_env,
        population=population,
        individual=individual,
        buffers=buffers,
        design_choice=rest.pop("design_choice", None) or DesignChoice(env.design_spec, **chosen | choosing),
        updates=UpdatePlan(**learnt | learning),
        **imagination | counts | rest,
    )
