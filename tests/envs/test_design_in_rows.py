"""Rows carry the body that was simulated: what a step, a reset and TorchRL's transforms may do with a design."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import (
    CatTensors,
    Compose,
    ConditionalSkip,
    DoubleToFloat,
    ObservationNorm,
    RenameTransform,
    RewardScaling,
    StepCounter,
    TensorDictPrimer,
    Transform,
    TransformedEnv,
    check_env_specs,
)

from coim.envs import HopperMorph


def drawn_per_episode(env: HopperMorph) -> TensorDictPrimer:
    return TensorDictPrimer(env.state_spec, random=True, call_before_env_reset=True)


def asked_for(design: float, key: str = "design") -> TensorDict:
    return TensorDict({key: torch.full((2, 4), design)}, [2])


def test_a_step_with_another_design_than_the_bodies_is_refused_and_moves_nothing() -> None:
    env = HopperMorph(num_runs=2, seed=0)
    td = env.reset()
    before = env.get_simulation_state()
    td["design"][1] = 1.9
    with pytest.raises(ValueError, match=r"\[1.89.*but the body is \[1.0, .*call_before_env_reset=True"):
        env.step(td.set("action", torch.zeros(2, 3)))
    assert (env.get_simulation_state() == before).all()


def test_a_step_needs_no_design_and_takes_one_that_was_only_rounded() -> None:
    env = HopperMorph(num_runs=2, seed=0)
    env.reset(asked_for(1.3))
    for given in ({}, {"design": torch.full((2, 4), 1.3, dtype=torch.float64) + 1e-6}):
        after = env.step(TensorDict({"action": torch.zeros(2, 3), **given}, [2]))["next"]
        assert after["design"].equal(torch.full((2, 4), 1.3))


def test_a_collector_draws_a_body_per_episode_with_a_primer_before_the_reset() -> None:
    from torchrl.collectors import Collector

    env = HopperMorph(num_runs=2, seed=0, episode_steps=5)
    collector = Collector(TransformedEnv(env, drawn_per_episode(env)), None, frames_per_batch=40, total_frames=40)
    (batch,) = [batch.clone() for batch in collector]
    collector.shutdown()
    assert batch.batch_size == (2, 20)
    assert batch["design"].equal(batch["next", "design"])
    episodes = batch["design"].unflatten(1, (4, 5))
    assert (episodes == episodes[:, :, :1]).all()
    assert len(episodes[:, :, 0].flatten(0, 1).unique(dim=0)) == 8
    # A body at rest stands at half its torso, its thigh, its shank and the ankle: the rows are those of their bodies.
    torso, thigh, shank, _ = (episodes[:, :, 0] * torch.tensor([0.4, 0.45, 0.5, 0.39])).unbind(-1)
    heights = batch["observation"].unflatten(1, (4, 5))[:, :, 0, 0]
    torch.testing.assert_close(heights, torso / 2 + thigh + shank + 0.1, rtol=0, atol=0.02)


def test_a_primer_that_writes_after_the_reset_is_refused() -> None:
    env = HopperMorph(num_runs=2, seed=0)
    primed = TransformedEnv(env, TensorDictPrimer(env.state_spec, random=True))
    with pytest.raises(ValueError, match="A TensorDictPrimer needs call_before_env_reset=True"):
        primed.rollout(3)


@pytest.mark.parametrize(
    "transform",
    [
        ObservationNorm(loc=1.0, scale=3.0, in_keys=["observation"]),
        ObservationNorm(loc=0.3, scale=3.0, in_keys=["design"], in_keys_inv=["design"]),
        ObservationNorm(loc=0.3, scale=3.0, in_keys=["design"], out_keys=["scaled_design"]),
        RewardScaling(loc=0.0, scale=2.0),
        Compose(StepCounter(3), DoubleToFloat()),
        CatTensors(["observation", "design"], "state", del_keys=False),
        RenameTransform(["observation"], ["state"]),
        RenameTransform(["design"], ["body"], create_copy=True),
    ],
    ids=lambda transform: type(transform).__name__,
)
def test_transforms_leave_bodies_and_rows_as_they_are(transform: Transform) -> None:
    bare, base = HopperMorph(num_runs=2, seed=0), HopperMorph(num_runs=2, seed=0)
    env = TransformedEnv(base, transform.clone())
    check_env_specs(env)
    env.set_seed(0)
    for e in (bare, env):
        td = e.reset(asked_for(1.6))
        for action in torch.rand(6, 2, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1:
            td = e.step(td.set("action", action))["next"].exclude("reward")
    assert (bare.get_simulation_state() == base.get_simulation_state()).all()


@pytest.mark.parametrize("inverse", [{}, {"in_keys_inv": ["design"], "out_keys_inv": ["body"]}])
def test_a_renamed_design_that_a_reset_would_lose_is_refused(inverse: dict[str, list[str]]) -> None:
    env = TransformedEnv(HopperMorph(num_runs=2, seed=0), RenameTransform(["design"], ["body"], **inverse))
    with pytest.raises(ValueError, match=r"nothing named 'design'.*enable_inv_on_reset = True"):
        env.reset(asked_for(1.5, "body"))


def test_a_renamed_design_is_built_where_its_inverse_is_on_at_the_reset() -> None:
    rename = RenameTransform(["design"], ["body"], ["design"], ["body"])
    rename.enable_inv_on_reset = True
    env = TransformedEnv(HopperMorph(num_runs=2, seed=0), rename)
    td = env.rollout(3, auto_reset=False, tensordict=env.reset(asked_for(1.5, "body")))
    assert td["body"].equal(torch.full((2, 3, 4), 1.5))
    assert td["observation"][0, 0, 0].item() == pytest.approx(1.5 * 1.15 + 0.1, abs=0.006)


def test_a_misspelt_design_is_refused_and_an_empty_reset_keeps_the_bodies() -> None:
    env = HopperMorph(num_runs=2, seed=0)
    with pytest.raises(ValueError, match="holds 'desing' and nothing named 'design'"):
        env.reset(asked_for(1.5, "desing"))
    env.reset(asked_for(1.5))
    empty = TensorDict({}, [2])
    assert env.reset(empty) is empty
    assert empty["design"].equal(torch.full((2, 4), 1.5))
    assert empty["observation"].shape == (2, 11)


def test_rows_that_are_not_stepped_stand_still_and_the_others_do_not_notice() -> None:
    env, whole = (HopperMorph(num_runs=2, seed=0, episode_steps=4) for _ in range(2))
    td, expected = env.reset(), whole.reset()
    before = td["observation"].clone()
    for action in torch.rand(4, 2, 3, generator=torch.Generator().manual_seed(0)):
        asked = td.clone().update({"action": action, "_step": torch.tensor([True, False])})
        td = env.step(asked)["next"]
        expected = whole.step(expected.set("action", action))["next"]
        assert td["observation"][0].equal(expected["observation"][0])
        assert td["observation"][1].equal(before[1])
        assert td["reward"][1] == 0
        td, expected = td.exclude("reward"), expected.exclude("reward")
    assert td["truncated"].flatten().tolist() == [True, False]
    after = env.step(td.set("action", torch.zeros(2, 3)))["next", "observation"]
    assert after[1].equal(
        HopperMorph(num_runs=2, seed=0).rollout(1, lambda td: td.set("action", torch.zeros(2, 3)))[1][
            "next", "observation"
        ][0]
    )


def test_a_skipping_transform_skips_its_rows_only() -> None:
    def act_on_the_first(td: TensorDict) -> torch.Tensor:
        return torch.tensor([False, True])  # True: is skipped

    env = TransformedEnv(HopperMorph(num_runs=2, seed=0), ConditionalSkip(act_on_the_first))
    rows = env.rollout(3)
    assert (rows["observation"][1] == rows["next", "observation"][1]).all()
    assert (rows["observation"][0] != rows["next", "observation"][0]).any(-1).all()
