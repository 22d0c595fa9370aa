"""Imagination from states that were put under the new body, and anchored at real transitions.  N states, K runs."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from coim.buffers import ROW_KEYS, transition_rows
from coim.designs import KnownDesigns, RandomDesigns
from coim.envs import BODIES, HalfCheetahMorph, HopperMorph, MorphEnv, SimulatorDynamics, WalkerMorph, WorldModelEnv
from coim.imagination import CHUNK_ROWS, imagine
from coim.models import GaussianEnsemble, make_policy
from coim.pairs import impossible_pairs

PITCH = 1  # entry of a hopper's observation


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def real_rows(body: type[MorphEnv] = HopperMorph, num_runs: int = 6, *, steps: int = 40) -> TensorDict:
    """Transitions of different bodies under random actions, ``[T, K]``."""
    torch.manual_seed(0)
    env = body(num_runs=num_runs, seed=0)
    designs = RandomDesigns(env.design_spec)(torch.ones(num_runs, body.DESIGN_SIZE), rng=rng())
    start = env.reset(TensorDict({"design": designs}, [num_runs]))
    return transition_rows(env.rollout(steps, auto_reset=False, tensordict=start)).transpose(0, 1)


def dreamt(env: MorphEnv, *, num_runs: int | None = None) -> WorldModelEnv:
    """A dream of an ensemble that has learnt nothing, but knows the scale of what it would predict."""
    torch.manual_seed(0)
    ensemble = GaussianEnsemble.for_env(env, num_cells=(16,), num_runs=num_runs)
    ensemble.update_statistics(real_rows() if num_runs is None else real_rows(num_runs=num_runs))
    return WorldModelEnv(ensemble, env, batch_size=[1], seed=0)


class Index:
    """A model whose member m predicts no change of the state but m in each entry."""

    def sample(self, observation: Tensor, action: Tensor, design: Tensor, *, generator: Any = None) -> Tensor:
        return self.means((observation, action, design), generator=generator)[0]

    def means(self, *asked: tuple[Tensor, Tensor, Tensor], generator: Any = None) -> tuple[Tensor, ...]:
        member = torch.randint(1000, asked[0][0].shape[:-1], generator=generator)[..., None]
        return tuple(one[0] + member for one in asked)


@pytest.mark.parametrize("anchored", [False, True])
@pytest.mark.parametrize("body", [HalfCheetahMorph, WalkerMorph, HopperMorph])
def test_matched_states_keep_all_but_the_height_of_the_root_and_none_is_in_the_floor(
    body: type[MorphEnv], anchored: bool
) -> None:
    env, states = body(seed=0), real_rows(body).flatten()
    dream = WorldModelEnv(GaussianEnsemble.for_env(env, num_cells=(8,)), env, batch_size=[1], seed=0)
    policy = make_policy(env, num_cells=(8,))
    how: dict[str, Any] = {"rng": rng(), "anchored": anchored}
    rows = imagine(dream, states, policy, RandomDesigns(env.design_spec), states_are="matched", **how)
    assert not torch.equal(rows["design"], states["design"])
    assert not impossible_pairs(env.clearance, rows["observation"], rows["design"]).any()
    clearance = env.clearance(states["observation"], states["design"])
    assert (clearance > -0.05).all()  # so every row is its own, in its place
    torch.testing.assert_close(env.clearance(rows["observation"], rows["design"]), clearance, atol=1e-5, rtol=0)
    moved = (rows["observation"] != states["observation"]).any(0).nonzero().flatten().tolist()
    assert moved == [1 - env.first_position]
    if body is not HalfCheetahMorph:  # its legs are bent, and hardly any of its states goes into the floor
        stored = imagine(dream, states, policy, RandomDesigns(env.design_spec), rng=rng())
        assert impossible_pairs(env.clearance, stored["observation"], stored["design"]).float().mean() > 0.3


def test_a_pair_that_cannot_be_is_not_imagined_and_another_one_of_its_run_is_instead() -> None:
    env = HopperMorph(num_runs=2, seed=0)
    states = real_rows(num_runs=2, steps=6)
    states["observation"][:4, 1, 0] -= 1.0  # m: the second run's first four are deep in the floor
    policy = make_policy(env, num_cells=(8,), num_runs=2)
    rows = imagine(dreamt(env, num_runs=2), states, policy, KnownDesigns(), states_are="matched", rng=rng())
    assert torch.equal(rows["observation"][:, 0], states["observation"][:, 0])
    assert torch.equal(rows["observation"][:, 1], states["observation"][[4, 5, 4, 5, 4, 5], 1])
    assert rows["action"][0, 1].tolist() != rows["action"][2, 1].tolist()  # imagined twice, not copied
    with pytest.raises(ValueError, match="none of the 4 rows"):
        imagine(dreamt(env, num_runs=2), states[:4], policy, KnownDesigns(), states_are="matched", rng=rng())


def test_a_small_last_chunk_need_not_have_a_possible_pair(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CHUNK_ROWS, "cpu", 4)
    env, states = HopperMorph(seed=0), real_rows(num_runs=1, steps=5)[:, 0]
    states["observation"][4, 0] -= 1.0
    rows = imagine(dreamt(env), states, make_policy(env), KnownDesigns(), states_are="matched", rng=rng())
    assert torch.equal(rows["observation"][4], states["observation"][0])


@pytest.mark.parametrize("states_are", ["stored", "matched"])
@pytest.mark.parametrize("name", BODIES)
def test_anchored_and_unchanged_is_the_real_transition_to_the_last_bit(name: str, states_are: Any) -> None:
    env, states = BODIES[name](seed=0), real_rows(BODIES[name]).flatten()
    dream = WorldModelEnv(GaussianEnsemble.for_env(env, num_cells=(8,)), env, batch_size=[1], seed=0)
    rows = imagine(
        dream, states, make_policy(env), KnownDesigns(), states_are=states_are, anchored=True, actions="replayed"
    )
    for key in ROW_KEYS:
        assert torch.equal(rows[key], states[key]) or key[-1] in ("reward", "truncated", "done"), key
    torch.testing.assert_close(rows["next", "reward"], states["next", "reward"])


@pytest.mark.parametrize("body", [HalfCheetahMorph, WalkerMorph, HopperMorph])
def test_anchored_at_the_twin_simulator_every_row_is_the_simulators_own(body: type[MorphEnv]) -> None:
    env, states = body(seed=0), real_rows(body).flatten()
    truth = SimulatorDynamics(body(num_runs=8))
    dream = WorldModelEnv(truth, env, batch_size=[1])
    policy, uniform = make_policy(env, num_cells=(8,)), RandomDesigns(env.design_spec)
    rows = imagine(dream, states, policy, uniform, states_are="matched", anchored=True, rng=rng())
    own = truth.sample(rows["observation"], rows["action"], rows["design"])
    # A float32 observation is not the simulation's float64 state, and knows nothing of the solver's warm start.
    torch.testing.assert_close(rows["next", "observation"], own, rtol=1e-3, atol=1e-3)
    reward = env.reward_fn(rows["observation"], rows["action"], rows["next", "observation"], rows["design"])
    assert torch.equal(rows["next", "reward"], reward)
    states["next", "observation"] = truth.sample(states["observation"], states["action"], states["design"])
    rows = imagine(dream, states, policy, uniform, states_are="matched", anchored=True, rng=rng())
    torch.testing.assert_close(rows["next", "observation"], own, rtol=1e-5, atol=1e-5)


def test_the_root_is_lifted_once_by_one_member_in_both_terms() -> None:
    env, states = HopperMorph(seed=0), real_rows().flatten()
    dream = WorldModelEnv(Index(), env, batch_size=[1], seed=0)
    rows = imagine(
        dream, states, make_policy(env), RandomDesigns(env.design_spec), states_are="matched", anchored=True, rng=rng()
    )
    lifted = rows["observation"] - states["observation"]
    assert lifted[:, 0].abs().max() > 0.3  # m
    # Two members would differ by hundreds; a second lift would be those 0.3 m.
    error = rows["next", "observation"] - (states["next", "observation"] + lifted)
    assert error.abs().max() < 1e-3


def test_the_pitch_is_wrapped_where_the_difference_takes_it_past_pi() -> None:
    class Turning(Index):
        def means(self, *asked: tuple[Tensor, Tensor, Tensor], generator: Any = None) -> tuple[Tensor, ...]:
            return tuple(one[0] + 0.5 * one[1][..., :1] for one in asked)

    env, states = HopperMorph(seed=0), real_rows().flatten()[:2]
    states["next", "observation"][:, PITCH] = math.pi - 0.1
    states["action"][:] = torch.tensor([[0.0], [-0.8]])
    dream = WorldModelEnv(Turning(), env, batch_size=[1])
    policy = make_policy(env, num_cells=(8,))
    rows = imagine(dream, states, policy, KnownDesigns(), anchored=True, rng=rng())
    turned = math.pi - 0.1 + 0.5 * (rows["action"][:, 0] - torch.tensor([0.0, -0.8]))
    expected = torch.where(turned > math.pi, turned - math.tau, turned)
    assert (turned > math.pi).any()
    torch.testing.assert_close(rows["next", "observation"][:, PITCH], expected)


def test_a_broken_simulation_is_no_anchor() -> None:
    env, states = HopperMorph(seed=0), real_rows(num_runs=1, steps=4)[:, 0]
    states["next", "terminated"][1] = True
    how: dict[str, Any] = {"anchored": True, "actions": "replayed"}
    rows = imagine(dreamt(env), states, make_policy(env), KnownDesigns(), **how)
    assert torch.equal(rows["observation"], states["observation"][[0, 0, 2, 3]])


def test_fresh_actions_are_the_policys_and_replayed_ones_those_of_the_rows() -> None:
    env, states = HopperMorph(seed=0), real_rows().flatten()
    policy, uniform = make_policy(env, num_cells=(8,)), RandomDesigns(env.design_spec)
    fresh, replayed = (
        imagine(dreamt(env), states, policy, uniform, states_are="matched", actions=actions, rng=rng())
        for actions in ("fresh", "replayed")
    )
    assert torch.equal(replayed["action"], states["action"])
    assert not torch.isin(fresh["action"], states["action"]).any()


def test_a_run_of_a_fleet_imagines_from_its_own_transitions_alone() -> None:
    env = HopperMorph(num_runs=3, seed=0)
    policy, states = make_policy(env, num_cells=(8,), num_runs=3), real_rows(num_runs=3)
    how: dict[str, Any] = {"states_are": "matched", "anchored": True}
    uniform = RandomDesigns(env.design_spec)
    rows = imagine(dreamt(env, num_runs=3), states, policy, uniform, **how, rng=rng())
    other = states.clone()
    other["observation"][:4, 1, 0] -= 1.0
    other["next", "observation"][:, 1] += 0.1
    changed = imagine(dreamt(env, num_runs=3), other, policy, uniform, **how, rng=rng())
    assert torch.equal(rows["next", "observation"][:, [0, 2]], changed["next", "observation"][:, [0, 2]])
    assert not torch.equal(rows["next", "observation"][:, 1], changed["next", "observation"][:, 1])


def test_random_numbers_come_from_the_one_generator_and_the_global_one_stays() -> None:
    env, states = HopperMorph(seed=0), real_rows().flatten()
    policy, uniform = make_policy(env, num_cells=(8,)), RandomDesigns(env.design_spec)
    dream, before = dreamt(env), torch.get_rng_state()
    how: dict[str, Any] = {"states_are": "matched", "anchored": True}
    one, again, other = (imagine(dream, states, policy, uniform, **how, rng=rng(n)) for n in (1, 1, 2))
    assert (one == again).all()
    assert not torch.equal(one["action"], other["action"])
    assert torch.equal(torch.get_rng_state(), before)


def test_what_cannot_be_done_is_named() -> None:
    env, states = HopperMorph(seed=0), real_rows().flatten()
    dream, policy, known = dreamt(env), make_policy(env, num_cells=(8,)), KnownDesigns()
    unknown: dict[str, Any] = {"states_are": "moved"}
    with pytest.raises(ValueError, match="states_are='moved' is unknown; choose 'stored' or 'matched'"):
        imagine(dream, states, policy, known, **unknown)
    unknown = {"actions": "old"}
    with pytest.raises(ValueError, match="actions='old' is unknown; choose 'fresh' or 'replayed'"):
        imagine(dream, states, policy, known, **unknown)
    with pytest.raises(ValueError, match=r"lack \[\('next', 'observation'\), \('next', 'terminated'\)\]"):
        imagine(dream, states.exclude("next"), policy, known, anchored=True)
    with pytest.raises(ValueError, match=r"lack \['action'\]"):
        imagine(dream, states.exclude("action"), policy, known, actions="replayed")
    dream.transfer = None
    with pytest.raises(TypeError, match="make the dream of a MorphEnv, or leave the states 'stored'"):
        imagine(dream, states, policy, known, states_are="matched")
    with pytest.raises(TypeError, match=r"a Sampler has no means\(\) to anchor with"):
        imagine(WorldModelEnv(Sampler(), env, batch_size=[1]), states, policy, known, anchored=True)


class Sampler:
    """A model that can only be sampled."""

    def sample(self, observation: Tensor, action: Tensor, design: Tensor, *, generator: Any = None) -> Tensor:
        return observation
