"""One-step imagination.  N states, K runs, S state, A action, D design."""

from __future__ import annotations

from typing import cast

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.data import Bounded
from torchrl.modules import TanhNormal

from coim.buffers import ROW_KEYS, TransitionBuffer, transition_rows
from coim.designs import KnownDesigns, NoisyDesigns, RandomDesigns
from coim.envs.hopper import HopperMorph
from coim.envs.world_model import WorldModelEnv
from coim.imagination import CHUNK_ROWS, imagine
from coim.models.ensemble import GaussianEnsemble
from coim.models.policy import make_policy as make_real_policy
from coim.models.stacked import select_run

SPEC = Bounded(low=0.5, high=2.0, shape=(2,))


class Dream:
    """Stands in for the dream: s' = s + design + noise, r = sum(a); remembers what it was asked."""

    def __init__(self, prediction: float = 0.0) -> None:
        self.prediction = prediction
        self.asked: list[tuple[int, ...]] = []

    def advance(
        self, observation: Tensor, action: Tensor, design: Tensor, *, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        assert not torch.is_grad_enabled()
        self.asked.append(tuple(observation.shape[:-1]))
        noise = torch.rand(observation.shape, generator=generator)
        after = observation + design.sum(-1, keepdim=True) + noise + self.prediction
        return after, action.sum(-1, keepdim=True)


def as_dream(dream: Dream) -> WorldModelEnv:
    return cast(WorldModelEnv, dream)


def make_policy() -> TensorDictSequential:
    """Tanh-normal whose loc is the first design entry, with a width that leaves room for randomness."""
    network = TensorDictModule(
        lambda observation, design: (design[..., :1], torch.full_like(design[..., :1], 0.5)),
        in_keys=["observation", "design"],
        out_keys=["loc", "scale"],
    )
    head = ProbabilisticTensorDictModule(in_keys=["loc", "scale"], out_keys=["action"], distribution_class=TanhNormal)
    return TensorDictSequential(network, head)


def make_states(*batch_size: int) -> TensorDict:
    observation = torch.arange(torch.Size(batch_size).numel()).float().view(*batch_size, 1).expand(*batch_size, 3)
    return TensorDict(
        {"observation": observation, "design": torch.ones(*batch_size, 2), "more": observation}, batch_size
    )


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("batch_size", [(51,), (51, 3), (1,)])
def test_rows_have_the_schema_of_the_buffers(batch_size: tuple[int, ...]) -> None:
    rows = imagine(as_dream(Dream()), make_states(*batch_size), make_policy(), KnownDesigns())
    assert rows.batch_size == batch_size
    assert set(rows.keys(include_nested=True, leaves_only=True)) == set(ROW_KEYS)
    assert rows["next", "terminated"].dtype == torch.bool
    assert not (rows["next", "done"] | rows["next", "terminated"] | rows["next", "truncated"]).any()


def test_known_designs_keep_state_and_design() -> None:
    states = make_states(20)
    rows = imagine(as_dream(Dream()), states, make_policy(), KnownDesigns())
    assert torch.equal(rows["observation"], states["observation"])
    assert torch.equal(rows["design"], states["design"])
    assert torch.equal(rows["next", "reward"], rows["action"].sum(-1, keepdim=True))


def test_policy_dynamics_and_row_all_see_the_generated_design() -> None:
    states = make_states(4000)
    rows = imagine(as_dream(Dream()), states, make_policy(), RandomDesigns(SPEC), rng=rng())
    assert SPEC.is_in(rows["design"])
    assert torch.equal(rows["observation"], states["observation"])
    assert torch.equal(rows["next", "design"], rows["design"])
    grown = rows["next", "observation"] - rows["observation"] - rows["design"].sum(-1, keepdim=True)
    assert grown.min() > -1e-3
    assert grown.max() < 1 + 1e-3
    drawn = rows["action"].clamp(-0.9999, 0.9999).atanh() - rows["design"][:, :1]
    assert drawn.mean().item() == pytest.approx(0.0, abs=0.03)  # loc is the design that was generated
    assert drawn.std().item() == pytest.approx(0.5, rel=0.05)  # and it is sampled, not the mean


def test_large_batches_go_in_chunks_that_change_nothing_else() -> None:
    dream = Dream()
    size = CHUNK_ROWS["cpu"]
    imagine(as_dream(dream), make_states(2 * size + 1), make_policy(), KnownDesigns())
    assert dream.asked == [(size,), (size,), (1,)]
    dream.asked.clear()
    rows = imagine(as_dream(dream), make_states(2000, 3), make_policy(), KnownDesigns())
    assert dream.asked == [(1000, 3), (1000, 3)]
    assert torch.equal(rows["observation"], make_states(2000, 3)["observation"])


def test_devices_without_a_cache_to_keep_take_large_batches_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(CHUNK_ROWS, "cpu")  # as any other device
    dream = Dream()
    imagine(as_dream(dream), make_states(2_500, 3), make_policy(), KnownDesigns())
    assert dream.asked == [(2_500, 3)]


def test_a_generator_of_random_numbers_decides_everything_and_the_global_one_stays() -> None:
    before = torch.get_rng_state()
    noisy = NoisyDesigns(SPEC, sigma=0.1)
    once, again, other = (
        imagine(as_dream(Dream()), make_states(30), make_policy(), noisy, rng=rng(n)) for n in (1, 1, 2)
    )
    assert (once == again).all()
    for key in ("design", "action", ("next", "observation")):
        assert not torch.equal(once[key], other[key])
    assert torch.equal(torch.get_rng_state(), before)


def test_a_generator_of_random_numbers_goes_on_from_call_to_call() -> None:
    numbers = rng()
    first, second = (
        imagine(as_dream(Dream()), make_states(30), make_policy(), KnownDesigns(), rng=numbers) for _ in "ab"
    )
    assert not torch.equal(first["action"], second["action"])


def test_rows_fill_the_buffer_of_a_fleet() -> None:
    art = TransitionBuffer(51, num_runs=3, seed=0)
    art.extend(imagine(as_dream(Dream()), make_states(51, 3), make_policy(), KnownDesigns()))
    assert len(art) == 51


def test_states_are_left_alone_and_rows_are_their_own() -> None:
    states = make_states(5)
    before = states.clone()
    rows = imagine(as_dream(Dream()), states, make_policy(), KnownDesigns())
    rows["observation"].zero_()
    rows["design"].zero_()
    assert (states == before).all()
    assert set(states.keys()) == set(before.keys())


@pytest.mark.parametrize("broken", [float("nan"), float("inf")])
def test_a_model_that_is_not_finite_is_named(broken: float) -> None:
    with pytest.raises(ValueError, match="not finite"):
        imagine(as_dream(Dream(broken)), make_states(5), make_policy(), KnownDesigns())


def test_what_is_not_finite_is_told_by_who_gave_it() -> None:
    class Unpaid(Dream):
        """Pays the root of a negative number."""

        def advance(self, *given: Tensor, **how: torch.Generator | None) -> tuple[Tensor, Tensor]:
            after, reward = super().advance(*given, **how)
            return after, (reward - 10).sqrt()

    def broken(design: Tensor, rng: torch.Generator | None = None) -> Tensor:
        return design * torch.nan

    lost = make_states(5)
    lost["observation"] = lost["observation"] * torch.nan
    for dream, states, generator, sentence in (
        (Unpaid(), make_states(50), KnownDesigns(), r"an imagined step is nan for the body \[1.0, 1.0\], although"),
        (Dream(), make_states(5), broken, "the generator makes a design that is not finite"),
        (Dream(), lost, KnownDesigns(), "a state to imagine from is not finite"),
    ):
        with pytest.raises(ValueError, match=sentence):
            imagine(as_dream(dream), states, make_policy(), generator)
    diverged = TensorDictModule(
        lambda observation: observation[..., :1] * torch.nan, in_keys=["observation"], out_keys=["action"]
    )
    with pytest.raises(ValueError, match="the policy gives an action that is not finite"):
        imagine(as_dream(DreamOfActions()), make_states(5), diverged, KnownDesigns())


class DreamOfActions(Dream):
    """Goes where the action points."""

    def advance(
        self, observation: Tensor, action: Tensor, design: Tensor, *, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        return observation + action, action


def test_a_generator_that_works_in_place_changes_no_row() -> None:
    states = make_states(5)
    rows = imagine(as_dream(Dream()), states, make_policy(), lambda design, rng=None: design.mul_(1.5))
    assert (states["design"] == 1.0).all()
    assert (rows["design"] == 1.5).all()


def test_axes_that_would_be_misread_are_refused() -> None:
    with pytest.raises(ValueError, match=r"have batch size \[4, 3, 2\]; give \[N\], or \[N, K\]"):
        imagine(as_dream(Dream()), make_states(4, 3, 2), make_policy(), KnownDesigns())
    rollout = make_states(3, 3)
    rollout.names = [None, "time"]
    with pytest.raises(ValueError, match="time is the last dimension of rows"):
        imagine(as_dream(Dream()), rollout, make_policy(), KnownDesigns())


def test_nothing_to_imagine_from_is_named() -> None:
    with pytest.raises(ValueError, match=r"have batch size \[0\]; sample rows of Replay_Pop"):
        imagine(as_dream(Dream()), make_states(0), make_policy(), KnownDesigns())
    with pytest.raises(ValueError, match=r"lack \['design'\]"):
        imagine(as_dream(Dream()), make_states(3).exclude("design"), make_policy(), KnownDesigns())


@pytest.mark.parametrize("num_runs", [None, 3])
def test_hoppers_are_imagined_with_real_parts(num_runs: int | None) -> None:
    env = HopperMorph(num_runs=num_runs or 1, seed=0)
    real = transition_rows(env.rollout(10)).transpose(0, 1)
    states = real if num_runs else real[:, 0]
    dream = WorldModelEnv(GaussianEnsemble.for_env(env, num_cells=(8,), num_runs=num_runs), env, batch_size=[1])
    policy = make_real_policy(env, num_cells=(8,), num_runs=num_runs)
    rows = imagine(dream, states, policy, RandomDesigns(env.design_spec), rng=rng())
    assert rows.batch_size == states.batch_size
    assert {key: rows[key].dtype for key in ROW_KEYS} == {key: real[key].dtype for key in ROW_KEYS}
    assert {key: rows[key].shape for key in ROW_KEYS} == {key: states[key].shape for key in ROW_KEYS}
    here, there = rows["observation"], rows["next", "observation"]
    assert torch.equal(rows["next", "reward"], HopperMorph.reward(here, rows["action"], there, rows["design"]))
    assert not any(rows[key].requires_grad for key in ROW_KEYS)
    if num_runs:
        art = TransitionBuffer(10, num_runs=num_runs, seed=0)
        art.extend(rows)


def test_a_run_of_a_fleet_imagines_from_its_own_states_policy_and_model() -> None:
    env = HopperMorph(num_runs=3, seed=0)
    ensemble = GaussianEnsemble.for_env(env, num_members=1, num_cells=(8,), num_runs=3).double()
    policy = make_real_policy(env, num_cells=(8,), num_runs=3).double()
    states = env.rollout(10).transpose(0, 1).select("observation", "design").double()

    def imagined(states: TensorDict) -> TensorDict:
        dream = WorldModelEnv(ensemble, env, batch_size=[1])
        return imagine(dream, states, policy, KnownDesigns(), rng=rng())

    rows, changed = imagined(states), states.clone()
    changed["observation"][:, 1] += 0.1
    others = imagined(changed)
    for key in ("action", ("next", "observation"), ("next", "reward")):
        assert torch.equal(rows[key][:, [0, 2]], others[key][:, [0, 2]])
        assert not torch.equal(rows[key][:, 1], others[key][:, 1])
    alone = select_run(policy, 1)(states[:, 1].clone())
    fleet = policy(states.clone())
    torch.testing.assert_close(fleet["loc"][:, 1], alone["loc"])
