"""What the networks' inputs are scaled by."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import (
    AsyncEnvPool,
    Compose,
    EnvBase,
    ObservationNorm,
    ParallelEnv,
    RenameTransform,
    RewardScaling,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    VecNormV2,
)

from coim import (
    GaussianEnsemble,
    HalfCheetahMorph,
    HopperMorph,
    SACLearner,
    WalkerMorph,
    WorldModelEnv,
    make_policy,
    make_qvalue,
    run_episode,
)
from coim.models import InputScaling


def foreign(design_spec: Bounded, *, device: str = "cpu") -> EnvBase:
    observation = Composite(observation=Unbounded((3,), device=device))
    specs = {"observation_spec": observation, "design_spec": design_spec, "action_spec": Bounded(-1, 1, shape=(2,))}
    return cast(EnvBase, SimpleNamespace(**specs))


def constants(env: EnvBase) -> list[list[float]]:
    return [buffer.tolist() for buffer in make_policy(env, num_cells=(8,)).network.scaling.buffers()]  # type: ignore[union-attr]


def normalised(*keys: str) -> TransformedEnv:
    return TransformedEnv(HopperMorph(seed=0), ObservationNorm(1.0, 2.0, in_keys=list(keys)))


@pytest.mark.parametrize("body", [HalfCheetahMorph, WalkerMorph, HopperMorph])
def test_the_constants_of_a_body_are_the_spreads_under_random_actions(body: type) -> None:
    env = body(num_runs=16, seed=0)
    rows = run_episode(env, None, rng=torch.Generator().manual_seed(0))
    ratio = rows["observation"].flatten(0, 1).std(0) / env.observation_scale
    if body is WalkerMorph:
        ratio = ratio[1:]  # the distance travelled is scaled by what walking covers, not by random actions
    assert ratio.min() > 0.4
    assert ratio.max() < 1.6


def test_networks_see_scaled_observations_and_designs_in_unit_range() -> None:
    env = HopperMorph(seed=0)
    policy = make_policy(env, num_cells=(8,))
    observation, design = env.observation_scale * 2, torch.tensor([0.5, 1.25, 2.0, 2.0])
    raw = policy.network.mlp(torch.full((11,), 2.0), torch.tensor([-1.0, 0.0, 1.0, 1.0]))
    torch.testing.assert_close(policy.network(observation, design)[0], raw[:3])


def test_without_constants_observations_pass_as_they_are(toy_env: object) -> None:
    scaling = InputScaling.for_env(toy_env)  # type: ignore[arg-type]
    observation = torch.randn(4, 3)
    assert torch.equal(scaling(observation, torch.ones(4, 2))[0], observation)


def test_walker_without_root_x_has_the_other_constants() -> None:
    scale = WalkerMorph().observation_scale
    assert torch.equal(WalkerMorph(observe_root_x=False).observation_scale, scale[1:])


def test_whatever_a_body_is_wrapped_in_networks_see_it_scaled_alike() -> None:
    env = HopperMorph(seed=0)
    dream = WorldModelEnv(GaussianEnsemble.for_env(env, num_cells=(8,)), env, batch_size=[4], seed=0)
    expected, state = constants(env), torch.get_rng_state()
    wrapped = (dream, TransformedEnv(env, Compose(StepCounter(), RewardScaling(0.0, 2.0))), SerialEnv(2, HopperMorph))
    for other in (*wrapped, TransformedEnv(ParallelEnv(2, HopperMorph), StepCounter())):
        torch.set_rng_state(state)
        weights = make_policy(env, num_cells=(8,)).network.mlp.layers[0].weight
        torch.set_rng_state(state)
        policy = make_policy(other, num_cells=(8,))
        assert [buffer.tolist() for buffer in policy.network.scaling.buffers()] == expected  # type: ignore[union-attr]
        assert torch.equal(policy.network.mlp.layers[0].weight, weights)
    assert (
        GaussianEnsemble.for_env(dream).angle_indices
        == GaussianEnsemble.for_env(SerialEnv(1, HopperMorph)).angle_indices
        == (1,)
    )


@pytest.mark.filterwarnings("ignore:Support of VecNormV2")
def test_observations_that_a_transform_has_scaled_are_not_scaled_again() -> None:
    ones = [1.0] * 11
    assert constants(normalised("observation"))[0] == ones
    assert constants(SerialEnv(1, lambda: normalised("observation")))[0] == ones
    assert constants(TransformedEnv(HopperMorph(seed=0), VecNormV2(in_keys=["observation"])))[0] == ones
    renamed = ObservationNorm(1.0, 2.0, in_keys=["observation"], out_keys=["other"])
    assert constants(TransformedEnv(HopperMorph(seed=0), renamed)) == constants(HopperMorph(seed=0))
    with pytest.raises(ValueError, match=r"entries \[1\] of the observation are angles, and a transform rewrites them"):
        GaussianEnsemble.for_env(normalised("observation"))


@pytest.mark.parametrize("make", [make_policy, make_qvalue, GaussianEnsemble.for_env])
def test_an_environment_without_an_observation_is_refused(make: Callable[..., Any]) -> None:
    env = TransformedEnv(HopperMorph(seed=0), RenameTransform(in_keys=["observation"], out_keys=["seen"]))
    with pytest.raises(ValueError, match=r"environment observes \['.*'\], and the networks read 'observation': keep"):
        make(env)


def test_designs_are_scaled_by_the_bounds_that_networks_see() -> None:
    policy = make_policy(normalised("design"), num_cells=(8,))  # 2 xi + 1: from 2 to 5
    design = policy.network.scaling.scaled_design(torch.tensor([2.0, 3.5, 5.0, 5.0]))  # type: ignore[union-attr]
    assert design.tolist() == [-1.0, 0.0, 1.0, 1.0]


@pytest.mark.parametrize("start", [HopperMorph, HopperMorph(seed=0)])
def test_bodies_in_a_pool_are_scaled_alike(start: Any) -> None:
    pool = AsyncEnvPool([start, start], backend="threading")
    try:
        assert constants(pool) == constants(HopperMorph(seed=0))
    finally:
        pool.close()


def test_workers_with_unlike_bodies_are_refused() -> None:
    unlike = SerialEnv(2, [HopperMorph, lambda: normalised("observation")])
    with pytest.raises(ValueError, match="the workers have unlike bodies"):
        make_policy(unlike)


@pytest.mark.parametrize("low", [0.5, -torch.inf, torch.finfo().min])
@pytest.mark.parametrize("high", [torch.inf, torch.finfo().max])
def test_entries_of_a_design_without_both_bounds_are_left_as_they_are(low: float, high: float) -> None:
    env = foreign(Bounded(torch.tensor([low, 0.5]), torch.tensor([high, 2.5]), shape=(2,)))
    scaling = InputScaling.for_env(env)
    assert scaling.scaled_design(torch.tensor([[3.0, 0.5], [-1.0, 2.5]])).tolist() == [[3.0, -1.0], [-1.0, 1.0]]
    ensemble = GaussianEnsemble.for_env(env, num_cells=(8,))
    assert ensemble.inputs.min_std[-2:].tolist() == pytest.approx([0.0, 2 / 12**0.5])


def test_bounds_that_differ_between_rows_are_refused() -> None:
    low = torch.tensor([[0.5, 0.5], [0.6, 0.5]])
    with pytest.raises(ValueError, match="other bounds in other rows"):
        InputScaling.for_env(foreign(Bounded(low, low + 1, shape=(2, 2))))


@pytest.mark.parametrize("make", [make_policy, make_qvalue, GaussianEnsemble.for_env])
def test_networks_are_born_on_the_device_and_in_the_dtype_of_what_they_see(
    make: Callable[..., nn.Module], toy_env: EnvBase
) -> None:
    def born() -> nn.Module:
        torch.manual_seed(0)
        return make(toy_env)

    def kinds(network: nn.Module) -> dict[str, tuple[str, torch.dtype]]:
        return {name: (t.device.type, t.dtype) for name, t in TensorDict.from_module(network).items(True, True)}

    expected = born()
    with torch.device("meta"):
        elsewhere = born()
    torch.set_default_dtype(torch.float64)
    try:
        precise = born()
    finally:
        torch.set_default_dtype(torch.float32)
    assert kinds(elsewhere) == kinds(precise) == kinds(expected)
    assert all(torch.equal(a, b) for a, b in zip(elsewhere.parameters(), expected.parameters()))
    toy_env = foreign(Bounded(0.5, 2.0, shape=(2,)), device="meta")
    assert {device for device, _ in kinds(born()).values()} == {"meta"}


def test_bad_scales_and_networks_that_disagree_are_refused() -> None:
    one = torch.ones(1)
    with pytest.raises(ValueError, match="must be positive"):
        InputScaling(torch.tensor([1.0, 0.0]), one, 2 * one)
    with pytest.raises(ValueError, match="must leave a range"):
        InputScaling(one, one, one)
    env = HopperMorph(seed=0)
    with pytest.raises(ValueError, match="have 11 and 4 numbers, this network was made for a body with 18 and 7; make"):
        env.rollout(2, make_policy(WalkerMorph(seed=0), num_cells=(8,)))
    qvalue = make_qvalue(env, num_cells=(8,))
    qvalue.module.scaling.observation_scale[0] = 7.0
    with pytest.raises(ValueError, match="scale their inputs differently"):
        SACLearner(make_policy(env, num_cells=(8,)), qvalue)
