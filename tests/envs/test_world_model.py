"""The dream: specs, resets, steps, and agreement with the real bodies.  N dreams, K runs, S state, D design."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import (
    CatTensors,
    EnvBase,
    ObservationNorm,
    PendulumEnv,
    RenameTransform,
    RewardScaling,
    SerialEnv,
    StepCounter,
    TensorDictPrimer,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from coim.envs.half_cheetah import HalfCheetahMorph
from coim.envs.hopper import HopperMorph
from coim.envs.morph import MorphEnv
from coim.envs.task import Task
from coim.envs.walker import WalkerMorph
from coim.envs.world_model import WorldModelEnv
from coim.models.ensemble import GaussianEnsemble

BODIES = [HalfCheetahMorph, WalkerMorph, HopperMorph]


class PointMass(EnvBase):
    """A mass ``design[0]`` on a line, pushed by the action; paid for its speed."""

    def __init__(self, num_runs: int = 1) -> None:
        super().__init__(batch_size=[num_runs])
        self.design_spec = Bounded(low=0.5, high=2.0, shape=(2,))
        observed = {"observation": Unbounded((num_runs, 3)), "design": self.design_spec.expand(num_runs, 2)}
        self.observation_spec = Composite(observed, shape=(num_runs,))
        self.state_spec = Composite(design=self.design_spec.expand(num_runs, 2), shape=(num_runs,))
        self.action_spec = Bounded(low=-1.0, high=1.0, shape=(num_runs, 1))
        self.reward_spec = Unbounded((num_runs, 1))
        flag = Binary(shape=(num_runs, 1), dtype=torch.bool)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=(num_runs,))

    @staticmethod
    def reward_fn(observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor) -> Tensor:
        return next_observation[..., 1:2] - 0.1 * action.square()

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: object) -> TensorDictBase:
        return self.observation_spec.zero().update(self.full_done_spec.zero())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise NotImplementedError

    def _set_seed(self, seed: int | None) -> None:
        pass


class Physics:
    """The point mass's own law, and a third entry that is noise."""

    def sample(
        self, observation: Tensor, action: Tensor, design: Tensor, *, generator: torch.Generator | None = None
    ) -> Tensor:
        place, speed = observation[..., :1], observation[..., 1:2]
        noise = torch.randn(place.shape, generator=generator, dtype=place.dtype)
        return torch.cat([place + 0.1 * speed, speed + 0.1 * action / design[..., :1], noise], -1)


def make_dream(*batch_size: int, num_runs: int = 1, seed: int | None = 0) -> WorldModelEnv:
    return WorldModelEnv(Physics(), PointMass(num_runs), batch_size=batch_size, seed=seed)


def start_of(*batch_size: int, seed: int = 0) -> TensorDict:
    rng = torch.Generator().manual_seed(seed)
    observation = torch.randn(*batch_size, 3, generator=rng)
    return TensorDict(
        {"observation": observation, "design": 0.5 + torch.rand(*batch_size, 2, generator=rng)}, batch_size
    )


@pytest.mark.parametrize(("batch_size", "num_runs"), [((256,), 1), ((256,), 3), ((1,), 1), ((), 1), ((5, 3), 3)])
def test_specs_hold_for_any_batch_size(batch_size: tuple[int, ...], num_runs: int) -> None:
    check_env_specs(make_dream(*batch_size, num_runs=num_runs))


def test_a_reset_starts_where_it_is_told_to() -> None:
    dream, start = make_dream(7), start_of(7)
    state = dream.reset(start.clone())
    assert torch.equal(state["observation"], start["observation"])
    assert torch.equal(state["design"], start["design"])
    assert not state["done"].any()
    assert torch.equal(dream.reset()["observation"], start["observation"])


def test_a_reset_may_give_only_new_designs() -> None:
    dream, start = make_dream(7), start_of(7)
    dream.reset(start)
    state = dream.reset(TensorDict({"design": torch.ones(7, 2)}, [7]))
    assert torch.equal(state["observation"], start["observation"])
    assert torch.equal(state["design"], torch.ones(7, 2))


def test_numbers_of_another_dtype_are_brought_to_that_of_the_specs() -> None:
    dream, twin, action = make_dream(7), make_dream(7), torch.full((7, 1), 0.5)
    for start in (start_of(7), start_of(7, seed=1)):
        state = dream.reset(start.double())
        assert torch.equal(state["observation"], start["observation"])
        given = TensorDict({**start.double(), "action": action.double()}, [7])
        after, expected = (env.step(td)["next"] for env, td in ((dream, given), (twin, start.set("action", action))))
        assert after["observation"].dtype == torch.float32
        assert (after == expected).all()


def test_a_step_by_hand() -> None:
    dream = make_dream(1)
    state = dream.reset(
        TensorDict({"observation": torch.tensor([[1.0, 2.0, 0.0]]), "design": torch.full((1, 2), 2.0)}, [1])
    )
    after = dream.step(state.set("action", torch.tensor([[1.0]])))["next"]
    assert after["observation"][0, :2].tolist() == pytest.approx([1.2, 2.05])
    assert after["reward"].tolist() == [[pytest.approx(1.95)]]
    assert after["design"].tolist() == [[2.0, 2.0]]
    assert not (after["done"] | after["terminated"] | after["truncated"]).any()


def test_a_rollout_carries_the_design_and_the_state() -> None:
    dream, start = make_dream(4, 3, num_runs=3), start_of(4, 3)
    rollout = dream.rollout(6, auto_reset=False, tensordict=dream.reset(start))
    assert rollout.batch_size == (4, 3, 6)
    assert torch.equal(rollout["design"], start["design"].unsqueeze(2).expand(4, 3, 6, 2))
    assert torch.equal(rollout["next", "design"], rollout["design"])
    assert torch.equal(rollout["observation"][..., 1:, :], rollout["next", "observation"][..., :-1, :])


def test_a_partial_reset_leaves_the_other_rows_alone() -> None:
    dream, start = make_dream(3), start_of(3)
    state = dream.step_and_maybe_reset(dream.rand_action(dream.reset(start.clone())))[1]
    here = state["observation"].clone()
    mask = torch.tensor([[False], [True], [False]])
    after = dream.reset(state.select("done", "terminated", "truncated", "observation", "design").set("_reset", mask))
    assert torch.equal(after["observation"][[0, 2]], here[[0, 2]])
    assert torch.equal(after["design"], start["design"])


def test_rows_that_are_not_reset_keep_their_start_and_may_hold_anything() -> None:
    dream, start = make_dream(3), start_of(3)
    dream.reset(start.clone())
    other = TensorDict({"observation": torch.full((3, 3), 5.0), "design": torch.full((3, 2), 0.7)}, [3])
    other["observation"][2] = torch.nan
    other["design"][0] = 9.0
    dream.reset(other.clone().set("_reset", torch.tensor([[False], [True], [False]])))
    again = dream.reset()
    for key in ("observation", "design"):
        assert torch.equal(again[key][1], other[key][1])
        assert torch.equal(again[key][[0, 2]], start[key][[0, 2]])
    with pytest.raises(ValueError, match="start observation holds nan"):
        dream.reset(other.set("_reset", torch.tensor([[False], [False], [True]])))


def test_a_horizon_starts_the_dream_again_from_its_start_states() -> None:
    dream, start = make_dream(3), start_of(3)
    env = TransformedEnv(dream, StepCounter(max_steps=4))
    state = env.reset(start.clone())
    rollout = env.rollout(9, break_when_any_done=False, auto_reset=False, tensordict=state)
    assert torch.equal(rollout["observation"][:, 0], start["observation"])
    assert torch.equal(rollout["observation"][:, 4], start["observation"])
    assert torch.equal(rollout["observation"][:, 8], start["observation"])
    assert torch.equal(rollout["design"], start["design"].unsqueeze(1).expand(3, 9, 2))
    assert rollout["next", "truncated"].sum() == 6


def test_the_same_seed_dreams_the_same_and_global_random_numbers_stay() -> None:
    before = torch.get_rng_state()
    start = start_of(5)
    action = torch.zeros(5, 1)
    dreams = [make_dream(5, seed=seed) for seed in (1, 1, 2)]
    after = [dream.step(dream.reset(start.clone()).set("action", action))["next", "observation"] for dream in dreams]
    assert torch.equal(after[0], after[1])
    assert not torch.equal(after[0], after[2])
    dreams[2].set_seed(1)
    again = dreams[2].step(dreams[2].reset(start.clone()).set("action", action))["next", "observation"]
    assert torch.equal(after[0], again)
    assert torch.equal(torch.get_rng_state(), before)


def test_unseeded_dreams_differ() -> None:
    first, second = (make_dream(5, seed=None).reset()["observation"] for _ in range(2))
    assert not torch.equal(first, second)


def test_advance_takes_any_batch_and_lets_gradients_through() -> None:
    action = torch.zeros(2, 4, 1, requires_grad=True)
    start = start_of(2, 4)
    after, reward = make_dream(1).advance(start["observation"], action, start["design"])
    assert (after.shape, reward.shape) == ((2, 4, 3), (2, 4, 1))
    reward.sum().backward()
    assert torch.allclose(action.grad, 0.1 / start["design"][..., :1])


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("design", 3.0, r"design \[3.0, 3.0\] leaves \[\[0.5, 0.5\], \[2.0, 2.0\]\]; project it"),
        ("design", float("nan"), "start design holds nan"),
        ("observation", float("inf"), "start observation holds inf"),
    ],
)
def test_a_bad_start_is_named_and_changes_nothing(key: str, value: float, message: str) -> None:
    dream, start = make_dream(4), start_of(4)
    dream.reset(start.clone())
    bad = start.clone()
    bad[key][2] = value
    with pytest.raises(ValueError, match=message):
        dream.reset(bad)
    assert torch.equal(dream.reset()[key], start[key])


def test_a_start_of_the_wrong_length_is_named() -> None:
    with pytest.raises(ValueError, match=r"start design has shape \[4, 3\], not \[4, 2\]"):
        make_dream(4).reset(TensorDict({"design": torch.ones(4, 3)}, [4]))


class Twin:
    """A perfect model: a second fleet of the same bodies, stepped beside the first and asked where it stands."""

    def __init__(self, env: MorphEnv, start: TensorDictBase) -> None:
        self.env = env
        self.here = env.reset(start)["observation"]

    def sample(
        self, observation: Tensor, action: Tensor, design: Tensor, *, generator: torch.Generator | None = None
    ) -> Tensor:
        assert torch.equal(observation, self.here)
        self.here, _, _ = self.env.advance(action)
        return self.here


class Simulator:
    """A perfect model: the simulator, set to each state and body that it is asked for."""

    def __init__(self, env: MorphEnv) -> None:
        self.env = env

    def sample(
        self, observation: Tensor, action: Tensor, design: Tensor, *, generator: torch.Generator | None = None
    ) -> Tensor:
        self.env.place(observation, design)
        return self.env.advance(action)[0]


def random_bodies(body: type[MorphEnv], num_runs: int, seed: int = 0) -> TensorDict:
    low, high = body.DESIGN_BOUNDS
    uniform = torch.rand(num_runs, body.DESIGN_SIZE, generator=torch.Generator().manual_seed(seed))
    return TensorDict({"design": low + (high - low) * uniform}, [num_runs])


@pytest.mark.parametrize("task", ["forward", "backward"])
@pytest.mark.parametrize("body", BODIES)
def test_a_perfect_model_dreams_the_real_observations_and_rewards_to_the_last_bit(
    body: type[MorphEnv], task: Task
) -> None:
    num_runs, steps = 4, 50
    bodies = random_bodies(body, num_runs)
    env = body(num_runs=num_runs, task=task, seed=0)
    start = env.reset(bodies.clone())
    twin = Twin(body(num_runs=num_runs, task=task, seed=0), bodies.clone())
    dream = WorldModelEnv(twin, env, batch_size=[num_runs])
    real = env.rollout(steps, auto_reset=False, tensordict=start.clone())
    actions = iter(real["action"].unbind(1))
    dreamt = dream.rollout(
        steps,
        lambda observation, design: next(actions),
        auto_reset=False,
        tensordict=dream.reset(start.select("observation", "design")),
    )
    for key in ("observation", "design", ("next", "observation"), ("next", "reward"), ("next", "design")):
        assert torch.equal(dreamt[key], real[key]), key


@pytest.mark.parametrize("body", BODIES)
def test_the_simulator_as_a_model_agrees_from_any_state_of_any_body(body: type[MorphEnv]) -> None:
    num_runs = 8
    torch.manual_seed(0)  # for the rollout's random actions
    env = body(num_runs=num_runs, seed=0)
    rows = env.rollout(30, auto_reset=False, tensordict=env.reset(random_bodies(body, num_runs)))[:, -1]
    dream = WorldModelEnv(Simulator(body(num_runs=num_runs)), env, batch_size=[num_runs])
    after = dream.step(dream.reset(rows.select("observation", "design")).set("action", rows["action"]))["next"]
    # A float32 observation is not the simulation's float64 state, and knows nothing of the solver's warm start.
    torch.testing.assert_close(after["observation"], rows["next", "observation"], rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(after["reward"], rows["next", "reward"], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("body", BODIES)
def test_specs_hold_with_a_real_body_and_a_real_ensemble(body: type[MorphEnv]) -> None:
    env = body(num_runs=2, seed=0)
    check_env_specs(WorldModelEnv(GaussianEnsemble.for_env(env, num_cells=(8,)), env, batch_size=[256]))
    fleet = GaussianEnsemble.for_env(env, num_cells=(8,), num_runs=2)
    check_env_specs(WorldModelEnv(fleet, env, batch_size=[16, 2]))


def test_a_fleet_of_models_dreams_rollouts_with_its_runs_last() -> None:
    env = HopperMorph(num_runs=3, seed=0)
    dream = WorldModelEnv(GaussianEnsemble.for_env(env, num_cells=(8,), num_runs=3), env, batch_size=[5, 3], seed=0)
    start = env.reset(random_bodies(HopperMorph, 3)).select("observation", "design").expand(5, 3)
    rollout = dream.rollout(4, auto_reset=False, tensordict=dream.reset(start.clone()))
    assert rollout.batch_size == (5, 3, 4)
    assert rollout["next", "observation"].isfinite().all()
    here, there, design = rollout["observation"], rollout["next", "observation"], rollout["design"]
    assert torch.equal(rollout["next", "reward"], HopperMorph.reward(here, rollout["action"], there, design))


def test_the_dream_does_not_step_the_real_bodies() -> None:
    env, untouched = (HopperMorph(num_runs=1, seed=0) for _ in range(2))
    dream = WorldModelEnv(GaussianEnsemble.for_env(env, num_cells=(8,)), env, batch_size=[1])
    dream.rollout(5)
    action = torch.zeros(1, 3)
    assert torch.equal(env.advance(action)[0], untouched.advance(action)[0])


# ---- transforms ----


def trajectory(env: EnvBase, start: TensorDict, steps: int = 4) -> TensorDict:
    """Steps from a start under actions that are the same each time."""
    actions = 2 * torch.rand(steps, 5, 1, generator=torch.Generator().manual_seed(2)) - 1
    td, rows = env.reset(start.clone()), []
    for action in actions:
        row = env.step(td.set("action", action))
        rows.append(row.clone())
        td = row["next"].exclude("reward")
    return torch.stack(rows)


@pytest.mark.parametrize(
    "transform",
    [
        ObservationNorm(loc=2.0, scale=10.0, in_keys=["observation"]),
        ObservationNorm(loc=2.0, scale=10.0, in_keys=["observation"], standard_normal=True),
        ObservationNorm(loc=2.0, scale=10.0, in_keys=["design"], out_keys=["scaled_design"]),
        ObservationNorm(loc=0.3, scale=2.0, in_keys=["design"], in_keys_inv=["design"]),
        RewardScaling(loc=1.0, scale=2.0),
        StepCounter(9),
        CatTensors(["observation", "design"], "both", del_keys=False),
        RenameTransform(["observation"], ["seen"], create_copy=True),
    ],
    ids=lambda transform: type(transform).__name__,
)
def test_the_dream_goes_the_same_way_behind_a_transform(transform: Transform) -> None:
    dream, bare, start = make_dream(5), make_dream(5), start_of(5)
    env = TransformedEnv(dream, transform.clone())
    check_env_specs(env)
    env.set_seed(0)
    bare.set_seed(0)
    rows, expected = trajectory(env, start), trajectory(bare, start)
    seen = expected.exclude("reward", ("next", "reward")).clone()
    if isinstance(transform, ObservationNorm):
        (key,), (out_key,) = transform.in_keys, transform.out_keys
        for at in (seen, seen["next"]):
            at[out_key] = transform._apply_transform(at[key])
    for key in ("observation", "design", ("next", "observation"), ("next", "design")):
        torch.testing.assert_close(rows[key], seen[key], rtol=1e-6, atol=1e-6)


def test_the_dream_itself_steps_the_states_that_it_is_given() -> None:
    dream, elsewhere = make_dream(2), torch.tensor([[5.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    dream.reset(start_of(2))
    given = {"observation": elsewhere, "design": torch.ones(2, 2), "action": torch.ones(2, 1)}
    after = dream.step(TensorDict(given, [2]))["next"]
    torch.testing.assert_close(after["observation"][:, :2], torch.tensor([[5.1, 1.1], [0.0, 0.1]]))
    again = dream.step(TensorDict({"action": torch.zeros(2, 1)}, [2]))["next"]  # no state: it goes on from its own
    torch.testing.assert_close(again["observation"][:, :2], torch.tensor([[5.21, 1.1], [0.01, 0.1]]))
    assert again["design"].tolist() == [[1.0, 1.0]] * 2


def test_behind_a_transform_a_design_that_is_not_the_dreams_is_refused() -> None:
    dream = make_dream(3)
    design = Composite(design=dream.state_spec["design"], shape=[3])
    primed = TransformedEnv(dream, TensorDictPrimer(design, random=True))
    with pytest.raises(ValueError, match=r"the input of the step has the design .* but the body is"):
        primed.rollout(2)
    before = TensorDictPrimer(design, random=True, call_before_env_reset=True)
    rows = TransformedEnv(dream, before).rollout(2)
    assert torch.equal(rows["design"], rows["next", "design"])
    renamed = TransformedEnv(make_dream(3), RenameTransform(["design"], ["body"]))
    with pytest.raises(ValueError, match="nothing named 'observation' or 'design'"):
        renamed.reset(TensorDict({"body": torch.ones(3, 2)}, [3]))


def test_an_empty_reset_goes_back_to_the_starts() -> None:
    dream, start, empty = make_dream(3), start_of(3), TensorDict({}, [3])
    dream.rollout(3, auto_reset=False, tensordict=dream.reset(start.clone()))
    assert torch.equal(dream.reset(empty)["observation"], start["observation"])
    assert torch.equal(empty["design"], start["design"])


def test_a_partial_reset_behind_a_transform_lets_the_other_rows_go_on() -> None:
    dream, start = make_dream(3), start_of(3)
    env = TransformedEnv(dream, ObservationNorm(loc=0.0, scale=10.0, in_keys=["observation"]))
    td = env.step(env.reset(start.clone()).set("action", torch.zeros(3, 1)))["next"].exclude("reward")
    env.reset(TensorDict({"_reset": torch.tensor([[False], [True], [False]])}, [3]))
    after = env.step(td.set("action", torch.zeros(3, 1)))["next", "observation"][:, 0] / 10
    place, speed = start["observation"][:, 0], start["observation"][:, 1]
    torch.testing.assert_close(after, place + 0.1 * speed * torch.tensor([2.0, 1.0, 2.0]))


def test_what_is_handed_out_may_be_written_to() -> None:
    env, whole = (TransformedEnv(make_dream(5), StepCounter()) for _ in range(2))
    start = start_of(5)
    for td in (spoilt := env.reset(start.clone()), whole.reset(start.clone())):
        td["action"] = torch.zeros(5, 1)
    for _ in range(3):
        after, expected = env.step(spoilt)["next"], whole.step(td)["next"]
        assert torch.equal(after["observation"], expected["observation"])
        after["observation"].zero_()
        spoilt, td = (x.exclude("reward").set("action", torch.zeros(5, 1)) for x in (after, expected))


def test_gradients_flow_through_a_transformed_rollout_unless_the_caller_cuts_them() -> None:
    env = TransformedEnv(make_dream(2), ObservationNorm(loc=0.0, scale=10.0, in_keys=["observation"]))
    for cut, expected in ((False, 0.1 * 10 * 0.1), (True, None)):
        action = torch.zeros(2, 1, requires_grad=True)
        td = env.reset(TensorDict({"observation": torch.zeros(2, 3), "design": torch.ones(2, 2)}, [2]))
        after = env.step(td.set("action", action))["next"].exclude("reward")
        after = after.detach() if cut else after
        place = env.step(after.set("action", torch.zeros(2, 1)))["next", "observation"][:, 0]
        assert place.requires_grad is not cut
        if not cut:
            (gradient,) = torch.autograd.grad(place.sum(), action)
            torch.testing.assert_close(gradient, torch.full((2, 1), expected))


def test_rows_that_are_not_stepped_stay_where_they_are() -> None:
    dream, start = make_dream(3), start_of(3)
    td = dream.reset(start.clone()).set("action", torch.zeros(3, 1)).set("_step", torch.tensor([True, False, True]))
    after = dream.step(td)["next"]
    assert torch.equal(after["observation"][1], start["observation"][1])
    assert (after["observation"][::2] != start["observation"][::2]).any(-1).all()
    assert (after["reward"] == 0).flatten().tolist() == [False, True, False]


# ---- copies and what is refused ----


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda dream: pickle.loads(pickle.dumps(dream))])
@pytest.mark.parametrize("wrapped", [False, True])
def test_a_copy_dreams_on_to_the_last_bit(copied: Callable, wrapped: bool) -> None:
    env = HopperMorph(num_runs=2, seed=0)
    dream: EnvBase = WorldModelEnv(GaussianEnsemble.for_env(env, num_cells=(8,)), env, batch_size=[4], seed=0)
    dream = TransformedEnv(dream, StepCounter(9)) if wrapped else dream
    td = dream.rand_step(dream.reset())["next"].exclude("reward")  # with the graph of the ensemble
    other = copied(dream)
    td["action"] = torch.zeros(4, 3)
    a, b = (x.step(td.clone())["next"] for x in (dream, other))
    assert torch.equal(a["observation"], b["observation"])
    assert torch.equal(dream.reset()["observation"], other.reset()["observation"])


def test_a_dream_that_is_moved_takes_its_random_numbers_and_its_states_along() -> None:
    start, moved, whole = start_of(5), make_dream(5), make_dream(5)
    for dream in (moved, whole):
        dream.reset(start.clone())
    assert moved.to("cpu") is moved
    assert moved.reset().device == torch.device("cpu")
    action = torch.zeros(5, 1)
    a, b = (dream.step(dream.reset().set("action", action))["next", "observation"] for dream in (moved, whole))
    assert torch.equal(a, b)


def test_what_is_no_bare_body_and_a_flat_reward_are_refused() -> None:
    class FlatlyPaid(PointMass):
        @staticmethod
        def reward_fn(observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor) -> Tensor:
            return next_observation[..., 1]

    with pytest.raises(TypeError, match=r"pass env.base_env to the dream"):
        WorldModelEnv(Physics(), TransformedEnv(PointMass(), StepCounter()), batch_size=[3])
    for env in (SerialEnv(2, PointMass), PendulumEnv()):
        with pytest.raises(TypeError, match=rf"a {type(env).__name__} has no reward_fn and design_spec of its own"):
            WorldModelEnv(Physics(), env, batch_size=[3])
    with pytest.raises(ValueError, match=r"the reward of FlatlyPaid has shape \[2\] .*not \[2, 1\]"):
        WorldModelEnv(Physics(), FlatlyPaid(), batch_size=[3])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_specs_hold_under_any_default_dtype(dtype: torch.dtype) -> None:
    torch.set_default_dtype(dtype)
    try:
        check_env_specs(make_dream(5))
        check_env_specs(WorldModelEnv(Simulator(HopperMorph(num_runs=4)), HopperMorph(), batch_size=[4]))
    finally:
        torch.set_default_dtype(torch.float32)
