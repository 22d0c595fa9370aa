"""The dream behind TorchRL's transforms: the same steps, and the caller's own tensors."""

from __future__ import annotations

import pytest
import torch
from point_mass_dream import make_dream, start_of
from tensordict import TensorDict
from torchrl.data import Composite
from torchrl.envs import (
    CatTensors,
    EnvBase,
    ObservationNorm,
    RenameTransform,
    RewardScaling,
    StepCounter,
    TensorDictPrimer,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs


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
