"""The simulator in the ensemble's place.  N rows asked for, K runs, D design."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from coim.buffers import transition_rows
from coim.designs import KnownDesigns, RandomDesigns
from coim.envs.half_cheetah import HalfCheetahMorph
from coim.envs.hopper import HopperMorph
from coim.envs.morph import MorphEnv
from coim.envs.simulator_dream import SimulatorDynamics
from coim.envs.walker import WalkerMorph
from coim.envs.world_model import WorldModelEnv
from coim.imagination import imagine
from coim.models.policy import make_policy


def real_rows(body: type[MorphEnv], num_runs: int = 7, *, steps: int = 30) -> TensorDict:
    """Transitions of different bodies under random actions, ``[K, T]``."""
    torch.manual_seed(0)  # for the rollout's random actions
    env = body(num_runs=num_runs, seed=0)
    designs = RandomDesigns(env.design_spec)(torch.ones(num_runs, body.DESIGN_SIZE))
    start = env.reset(TensorDict({"design": designs}, [num_runs]))
    return transition_rows(env.rollout(steps, auto_reset=False, tensordict=start))


@pytest.mark.parametrize("body", [HalfCheetahMorph, WalkerMorph, HopperMorph])
@pytest.mark.parametrize("fleet", [3, 7, 20])  # more rows than bodies, as many, fewer
def test_it_goes_on_from_any_state_of_any_body_as_the_bodies_did(body: type[MorphEnv], fleet: int) -> None:
    rows = real_rows(body)[:, -1]
    dream = WorldModelEnv(SimulatorDynamics(body(num_runs=fleet)), body(seed=0), batch_size=[7])
    after, reward = dream.advance(rows["observation"], rows["action"], rows["design"])
    # A float32 observation is not the simulation's float64 state, and knows nothing of the solver's warm start.
    torch.testing.assert_close(after, rows["next", "observation"], rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(reward, rows["next", "reward"], rtol=1e-3, atol=1e-3)


def test_who_else_is_asked_for_and_what_was_asked_before_change_nothing() -> None:
    rows = real_rows(HopperMorph).flatten()
    truth = SimulatorDynamics(HopperMorph(num_runs=4))

    def asked(some: slice | Tensor) -> Tensor:
        part = rows[some]
        return truth.sample(part["observation"], part["action"], part["design"])

    everything, order = asked(slice(None)), torch.randperm(len(rows))
    assert torch.equal(asked(order), everything[order])
    assert torch.equal(asked(slice(5, 6)), everything[5:6])


def test_a_fleet_of_runs_is_imagined_with_it_under_designs_that_were_never_built() -> None:
    states = real_rows(HopperMorph, 3).transpose(0, 1)
    env = HopperMorph(num_runs=3, seed=0)
    dream = WorldModelEnv(SimulatorDynamics(HopperMorph(num_runs=8)), env, batch_size=[3])
    policy = make_policy(env, num_cells=(8,), num_runs=3)
    rng = torch.Generator().manual_seed(0)
    rows = imagine(dream, states, policy, RandomDesigns(env.design_spec), rng=rng)
    assert rows.batch_size == (30, 3)
    assert not torch.equal(rows["design"], states["design"])
    alone = SimulatorDynamics(HopperMorph(num_runs=1))
    row = rows[17, 2:3]
    assert torch.equal(alone.sample(row["observation"], row["action"], row["design"]), row["next", "observation"])
    known = imagine(dream, states, policy, KnownDesigns(), rng=rng)
    assert torch.equal(known["design"], states["design"])


def test_a_simulation_that_breaks_stays_where_it_was_and_the_others_go_on() -> None:
    rows = real_rows(HopperMorph)[:, -1]
    truth = SimulatorDynamics(HopperMorph(num_runs=7))
    wild = rows["observation"].clone()
    wild[2, 5] = 1e7  # m/s
    after = truth.sample(wild, rows["action"], rows["design"])
    sound = truth.sample(rows["observation"], rows["action"], rows["design"])
    others = [0, 1, 3, 4, 5, 6]
    assert torch.equal(after[2], wild[2])
    assert torch.equal(after[others], sound[others])


def test_a_design_out_of_bounds_is_named() -> None:
    truth = SimulatorDynamics(HopperMorph(num_runs=2))
    with pytest.raises(ValueError, match=r"leaves \[0.5, 2\]"):
        truth.sample(torch.zeros(2, 11), torch.zeros(2, 3), torch.full((2, 4), 3.0))
