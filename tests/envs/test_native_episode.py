"""Episodes in native code: the physics of each row to the last bit, and the policy's actions up to rounding."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from two_link_arm import TWO_LINK_ARM

from coim import (
    AntMorph,
    HalfCheetahMorph,
    HopperMorph,
    MorphEnv,
    Policy,
    WalkerMorph,
    make_policy,
    morph_from_mjcf,
    run_episode,
    select_run,
)
from coim.buffers import ROW_KEYS
from coim.envs import native_episode
from coim.models import PolicyNetwork

STEPS = 60


def rng() -> torch.Generator:
    return torch.Generator().manual_seed(5)


def replayed(env: MorphEnv, actions: Tensor, design: Tensor) -> TensorDict:
    """The same actions once more, each given to the bodies from Python."""
    left = iter(actions)
    policy = TensorDictModule(lambda observation: next(left), in_keys=["observation"], out_keys=["action"])
    return run_episode(env, policy, design=design)


def same_state(one: MorphEnv, other: MorphEnv) -> bool:
    return bool((one.get_simulation_state() == other.get_simulation_state()).all())


def natively_and_replayed(
    make: Callable[[], MorphEnv], policy: Policy, design: Tensor, *, deterministic: bool = False
) -> tuple[TensorDict, TensorDict]:
    """Rows of two episodes in a row, after which both fleets are in the same state."""
    native, again = make(), make()
    rows = [run_episode(native, policy, design=design, deterministic=deterministic, rng=rng(), native=True)]
    others = [replayed(again, rows[0]["action"], design)]
    assert same_state(native, again)
    design = design.flip(0)  # other bodies after the first native episode
    rows.append(run_episode(native, policy, design=design, deterministic=deterministic, rng=rng(), native=True))
    others.append(replayed(again, rows[1]["action"], design))
    assert same_state(native, again)
    return torch.cat(rows), torch.cat(others)


def arm(tmp_path: Path) -> type[MorphEnv]:
    """A robot on a fixed base, whose motors have ranges of their own and whose shoulder turns for ever."""
    file = tmp_path / "arm.xml"
    file.write_text(TWO_LINK_ARM)
    return morph_from_mjcf(file, scale={"upper": ["upper"], "lower": ["lower"]}, reward=still)


def still(observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor, task: str) -> Tensor:
    return torch.zeros_like(observation[..., :1])


def noise_of(shape: tuple[int, ...]) -> Tensor:
    return torch.randn(STEPS, *shape, generator=rng())


@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize("body", [HopperMorph, HalfCheetahMorph, WalkerMorph, AntMorph, "arm"])
def test_rows_are_those_of_the_same_actions_and_actions_those_of_the_policy(
    body: type[MorphEnv] | str, own: bool, deterministic: bool, tmp_path: Path
) -> None:
    kind = arm(tmp_path) if isinstance(body, str) else body
    env = kind(num_runs=3, seed=0, episode_steps=STEPS)
    policy = make_policy(env, num_cells=(23, 9), num_runs=3 if own else None)
    design = env.design_spec.rand((3,))
    rows, again = natively_and_replayed(
        lambda: kind(num_runs=3, seed=0, episode_steps=STEPS), policy, design, deterministic=deterministic
    )
    for key in ROW_KEYS:
        assert torch.equal(rows[key], again[key]), key
    with torch.no_grad():
        loc, scale = policy.network(rows["observation"], rows["design"])
    noise = 0.0 if deterministic else noise_of(loc.shape[1:]).repeat(2, 1, 1)
    torch.testing.assert_close(rows["action"], (loc + scale * noise).tanh(), rtol=0, atol=2e-6)
    assert rows["action"].std() > 0.01


def test_one_body_acts_as_it_does_in_a_fleet_and_with_any_number_of_threads() -> None:
    fleet, threaded = (
        HopperMorph(num_runs=3, seed=0, reset_noise=0.0, episode_steps=STEPS, num_threads=threads) for threads in (1, 3)
    )
    policy = make_policy(fleet, num_cells=(32, 32), num_runs=3)
    design = fleet.design_spec.rand((3,))
    rows = run_episode(fleet, policy, design=design, deterministic=True, native=True)
    assert (run_episode(threaded, policy, design=design, deterministic=True, native=True) == rows).all()
    alone = HopperMorph(reset_noise=0.0, episode_steps=STEPS)
    own = run_episode(alone, select_run(policy, 1), design=design[1:2], deterministic=True, native=True)
    assert (own == rows[:, 1:2]).all()


@pytest.mark.parametrize("at_once", [1, 30, 5_000])
def test_a_body_that_breaks_starts_again_while_the_others_go_on(at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """What counts as broken is set so low that hopping does it, now and then; an episode may take many calls."""
    for module in ("native_episode", "simulation"):
        monkeypatch.setattr(f"coim.envs.{module}.BEYOND_PHYSICS", 5.0)
    monkeypatch.setattr(native_episode, "AT_ONCE", at_once)
    env = HopperMorph(num_runs=4, seed=0, episode_steps=STEPS)
    policy = make_policy(env, num_cells=(8,), num_runs=4)
    make = lambda: HopperMorph(num_runs=4, seed=0, episode_steps=STEPS)  # noqa: E731
    rows, again = natively_and_replayed(make, policy, torch.ones(4, 4))
    broken = rows["next", "terminated"].sum(0).squeeze(-1)
    assert broken.max() > 2
    assert len(broken.unique()) > 1
    for key in ROW_KEYS:
        assert torch.equal(rows[key], again[key]), key


@pytest.mark.parametrize("body", [HopperMorph, HalfCheetahMorph])
def test_every_warning_of_mujoco_breaks_a_body_also_one_that_it_gave_before_and_writes_nothing(
    body: type[MorphEnv], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Bodies that start with a hundred times what physics can bear, which MuJoCo puts back by itself."""
    monkeypatch.chdir(tmp_path)
    make = lambda: body(num_runs=3, seed=0, episode_steps=STEPS, reset_noise=100.0)  # noqa: E731
    design = torch.ones(3, body.DESIGN_SIZE)
    rows, again = natively_and_replayed(make, make_policy(make(), num_cells=(8,)), design)
    assert rows["next", "terminated"].sum(0).max() > 1
    for key in ROW_KEYS:
        assert torch.equal(rows[key], again[key]), key
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("limit", [1.3, 2.0])
def test_a_body_is_broken_where_positions_or_velocities_are_beyond_physics(
    limit: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hopper stands 1.25 m high; it moves slowly at first."""
    for module in ("native_episode", "simulation"):
        monkeypatch.setattr(f"coim.envs.{module}.BEYOND_PHYSICS", limit)
    make = lambda: HopperMorph(num_runs=2, seed=0, episode_steps=STEPS)  # noqa: E731
    rows, again = natively_and_replayed(
        make, make_policy(make(), num_cells=(8,)), torch.tensor([[1.0] * 4, [1.04] * 4])
    )
    assert 0 < rows["next", "terminated"].float().mean() < 1
    for key in ROW_KEYS:
        assert torch.equal(rows[key], again[key]), key


def test_an_error_of_mujoco_within_an_episode_breaks_the_body_and_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """A body with too little memory for its contacts."""
    asset = Path(native_episode.__file__).parent / "assets" / "hopper.xml"
    (tmp_path / "small.xml").write_text(asset.read_text().replace("<worldbody>", '<size memory="8K"/><worldbody>'))

    class Small(HopperMorph):
        ASSET = str(tmp_path / "small.xml")

    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    make = lambda: Small(num_runs=2, seed=0, episode_steps=300)  # noqa: E731
    rows, again = natively_and_replayed(make, make_policy(make(), num_cells=(8,), num_runs=2), torch.ones(2, 4))
    assert rows["next", "terminated"].any()
    for key in ROW_KEYS:
        assert torch.equal(rows[key], again[key]), key
    assert list(Path.cwd().iterdir()) == []
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("weight", [3e38, float("nan")])
def test_an_action_that_is_not_finite_is_refused_as_in_python(weight: float) -> None:
    env = HopperMorph(num_runs=2, seed=0, episode_steps=5)
    policy = make_policy(env, num_cells=(8,), num_runs=2)
    with torch.no_grad():
        for layer in policy.network.mlp.parameters():
            layer[1] = weight * torch.ones_like(layer[1]).cumsum(-1).sub(3).sign()
    start = HopperMorph(num_runs=2, seed=0)
    start.reset()
    with pytest.raises(ValueError, match=r"nan.* is not finite; the policy that gave it has diverged"):
        run_episode(env, policy, native=True)
    assert (env.simulations.qpos[1] == start.simulations.qpos[1]).all()
    assert (env.num_broken == 0).all()


def test_a_weight_that_is_not_finite_is_found_also_behind_a_unit_that_is_zero() -> None:
    env = HopperMorph(num_runs=2, seed=0, episode_steps=5)
    policy = make_policy(env, num_cells=(8,))
    with torch.no_grad():
        first, last = policy.network.mlp.layers
        first.bias[3] = -1e3
        last.weight[3] = torch.nan
    for native in (False, True):
        with pytest.raises(ValueError, match=r"nan.* is not finite; the policy that gave it has diverged"):
            run_episode(env, policy, native=native)


@pytest.mark.parametrize("order", ["bias first", "one more"])
def test_weights_are_read_by_name(order: str) -> None:
    one, other = (HopperMorph(num_runs=2, seed=0, episode_steps=5) for _ in range(2))
    policy = make_policy(one, num_cells=(8,))
    expected = run_episode(one, policy, rng=rng(), native=True)
    layer = policy.network.mlp.layers[0]
    if order == "bias first":
        weight = layer.weight
        del layer.weight
        layer.weight = weight
    else:
        layer.register_parameter("more", torch.nn.Parameter(torch.zeros(3)))
    assert (run_episode(other, policy, rng=rng(), native=True) == expected).all()


@pytest.mark.parametrize("lies", ["in a flat buffer", "transposed"])
def test_weights_are_read_wherever_they_lie(lies: str) -> None:
    """As a learner lays them: one buffer for all of a run's weights, the next run's after it."""
    one, other = (HopperMorph(num_runs=3, seed=0, episode_steps=STEPS) for _ in range(2))
    policy = make_policy(one, num_cells=(7, 5), num_runs=3)
    expected = run_episode(one, policy, rng=rng(), native=True)
    parameters = [*policy.parameters()]
    flat = torch.cat([parameter.detach().flatten(1) for parameter in parameters], 1)
    parts = flat.split([parameter[0].numel() for parameter in parameters], 1)
    for parameter, part in zip(parameters, parts):
        if lies == "transposed":
            parameter.data = parameter.data.mT.contiguous().mT if parameter.dim() == 3 else parameter.data
        else:
            parameter.data = part.view(parameter.shape)
    assert (run_episode(other, policy, rng=rng(), native=True) == expected).all()


@pytest.mark.parametrize("bias", [-30.0, 9.0])
def test_the_log_scale_is_clamped(bias: float) -> None:
    env = HopperMorph(seed=0, episode_steps=STEPS)
    policy = make_policy(env, num_cells=(8,))
    with torch.no_grad():
        policy.network.mlp.layers[-1].bias[3:] = bias
    rows = run_episode(env, policy, rng=rng(), native=True)
    with torch.no_grad():
        loc, scale = policy.network(rows["observation"], rows["design"])
    torch.testing.assert_close(rows["action"], (loc + scale * noise_of((1, 3))).tanh(), rtol=0, atol=2e-6)


@pytest.mark.parametrize(
    ("policy", "runs"),
    [
        (lambda env: make_policy(env, num_cells=(8,), num_runs=1), 3),
        (lambda env: make_policy(env, num_cells=(8,), num_runs=3), 5),
        (lambda env: make_policy(env, num_cells=(8,), num_runs=5), 3),
        (lambda env: Policy(PolicyNetwork(11, 4, 5, num_cells=(8,))), 3),
        (lambda env: Policy(PolicyNetwork(5, 4, 3, num_cells=(8,))), 3),
        (lambda env: Policy(PolicyNetwork(2, 4, 1, num_cells=(2,))), 64),
    ],
    ids=["one run of three", "three of five", "five of three", "actions", "observations", "both"],
)
def test_a_policy_of_other_sizes_is_refused_as_in_python(policy: Callable[[MorphEnv], Policy], runs: int) -> None:
    env = HopperMorph(num_runs=runs, seed=0, episode_steps=5)
    for native in (False, True):
        with pytest.raises(RuntimeError, match=r"size|shape|expand"):
            run_episode(env, policy(env), native=native)


def test_a_long_episode_is_left_between_its_calls(monkeypatch: pytest.MonkeyPatch) -> None:
    env = HopperMorph(num_runs=2, seed=0, episode_steps=STEPS)
    calls, apply = [], type(env.simulations).apply

    def interrupted(*given: object) -> object:
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return apply(*given)

    monkeypatch.setattr(type(env.simulations), "apply", interrupted)
    monkeypatch.setattr(native_episode, "AT_ONCE", 20)
    with pytest.raises(KeyboardInterrupt):
        run_episode(env, make_policy(env, num_cells=(8,)), native=True)
    assert env._step_count.flatten().tolist() == [20, 20]


def test_bodies_that_move_in_a_way_of_their_own_and_altered_policies_act_in_python() -> None:
    class Watched(HopperMorph):
        moves = 0

        def move(self, action: Tensor) -> tuple[Tensor, Tensor]:
            self.moves += 1
            return super().move(action)

    env, plain = Watched(seed=0, episode_steps=5), HopperMorph(seed=0, episode_steps=5)
    policy = make_policy(plain, num_cells=(8,))
    rows = run_episode(env, policy, rng=rng(), native=True)
    assert env.moves == 5
    assert (rows == run_episode(plain, policy, rng=rng())).all()

    moves = []
    watched = HopperMorph(seed=0, episode_steps=5)
    watched.move = lambda action: (moves.append(1), HopperMorph.move(watched, action))[1]
    run_episode(watched, policy, native=True)
    assert len(moves) == 5

    hooked = deepcopy(policy)
    hooked.network.mlp.layers[0].register_forward_hook(lambda module, given, out: -out)
    one, other = (HopperMorph(seed=0, episode_steps=5) for _ in range(2))
    assert (run_episode(one, hooked, rng=rng(), native=True) == run_episode(other, hooked, rng=rng())).all()


def test_a_policy_of_other_numbers_acts_in_python() -> None:
    one, other = (HopperMorph(seed=0, episode_steps=5) for _ in range(2))
    policy = make_policy(one, num_cells=(8,)).double()
    module = TensorDictModule(
        lambda observation, design: policy.deterministic_action(observation.double(), design.double()).float(),
        in_keys=["observation", "design"],
        out_keys=["action"],
    )
    assert (run_episode(one, module, native=True) == run_episode(other, module)).all()
