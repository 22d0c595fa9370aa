"""What the parts of Algorithm 1 must agree on, checked when they are put together.

Parts that do not fit would run for hours until one of them is needed, or to the end with wrong numbers. Each check
names the part, what it should be, and the way out.

Shapes: K runs, I first designs, N rows that are tried, D design, S observation, A action.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from numbers import Integral

import torch
from torch import Tensor
from torchrl.data import Bounded

from coim.buffers import Buffers
from coim.designs import DesignGenerator, DesignSearch
from coim.envs.morph import MorphEnv
from coim.envs.simulator_dream import SimulatorDynamics
from coim.envs.world_model import AnchoredDynamics, WorldModelEnv
from coim.learners.dynamics import DynamicsLearner
from coim.learners.sac import SACLearner
from coim.learners.written_out import check_exchangeable
from coim.models.ensemble import GaussianEnsemble

PRECISIONS = ("float32", "bfloat16")
TRIES = 16  # draws of G from each design that is tried


def check_counts(counts: Mapping[str, int], updates: Mapping[str, int]) -> None:
    """Refuse what is no whole number, counts below 1 and updates below 0, by their names."""
    for name, count in {**counts, **updates}.items():
        if isinstance(count, bool) or not isinstance(count, Integral):
            raise ValueError(f"{name} is {count!r}, it must be a whole number")
    for name, count in counts.items():
        if count < 1:
            raise ValueError(f"{name} is {count}, it must be at least 1")
    for name, count in updates.items():
        if count < 0:
            raise ValueError(f"{name} is {count}, it must be at least 0 (0 does not train)")


def check_words(**options: tuple[str, Sequence[str]]) -> None:
    """Refuse a word that an option, by its name, does not know."""
    for name, (word, known) in options.items():
        if word not in known:
            choices = ", ".join(repr(one) for one in known[:-1]) + f" or {known[-1]!r}"
            raise ValueError(f"{name}={word!r} is unknown; choose {choices}")


def check_kinds(parts: Mapping[str, tuple[object, type]]) -> None:
    """Refuse a part, by its name, that is something else than what it must be."""
    for name, (part, kind) in parts.items():
        if not isinstance(part, kind):
            raise TypeError(f"{name} is a {type(part).__name__}; pass a {kind.__name__}")


def check_precision(precision: str) -> None:
    """Refuse a precision that Eq. 5 would meet at the first search."""
    if precision not in PRECISIONS:
        raise ValueError(f"precision={precision!r} is unknown; choose 'float32' or 'bfloat16'")


def check_bodies(env: MorphEnv, evaluation_env: MorphEnv) -> None:
    """Refuse bodies behind transforms, and evaluation bodies that are those of training or are paid otherwise."""
    for name, bodies in (("env", env), ("evaluation_env", evaluation_env)):
        if not isinstance(bodies, MorphEnv):
            raise TypeError(
                f"{name} is a {type(bodies).__name__}, and episodes step the bodies themselves; pass a MorphEnv, which "
                "of a TransformedEnv is its base_env"
            )
    if env is evaluation_env:
        raise ValueError(
            "env and evaluation_env are one environment, and evaluating would change training; make two, with seeds of "
            "their own"
        )
    one, another = type(env), type(evaluation_env)
    if one is not another:
        raise ValueError(
            f"evaluation_env is a {another.__name__}, env a {one.__name__}; make both of one class, so that a run is "
            "judged by what it learns"
        )
    for what, own, other in (
        ("task", env.task, evaluation_env.task),
        ("batch size", list(env.batch_size), list(evaluation_env.batch_size)),
        ("device", str(env.design_spec.space.low.device), str(evaluation_env.design_spec.space.low.device)),
    ):
        if own != other:
            raise ValueError(f"evaluation_env has {what} {other}, env has {own}; make both alike but for their seeds")


def check_learners(
    env: MorphEnv,
    population: SACLearner,
    individual: SACLearner,
    dynamics: DynamicsLearner | None,
    *,
    side_by_side: bool,
) -> torch.device:
    """Refuse learners that share weights, lack the run axis of the bodies, or live apart.

    Returns:
        The device of all of them.
    """
    if population is individual:
        raise ValueError("population and individual are one learner; make two, with networks of their own")
    for name in ("policy", "qvalue"):
        if getattr(population, name) is getattr(individual, name):
            raise ValueError(f"population and individual share their {name}; make one for each of them")
    learners = {"population": population, "individual": individual, "dynamics": dynamics}
    runs, devices = env.batch_size.numel(), {}
    for name, learner in learners.items():
        if learner is None:
            continue
        if (learner.num_runs or 1) != runs:
            raise ValueError(
                f"{name} has num_runs={learner.num_runs}, the bodies have {runs} run(s); make its networks and itself "
                f"with num_runs={runs}"
            )
        devices[name] = learner.weights_by_run()[0].device
    device = devices["population"]
    for name, other in devices.items():
        if other != device:
            raise ValueError(f"population is on {device}, {name} on {other}; make all learners on one device")
    if side_by_side and device.type != "cpu":
        raise ValueError(
            f"side_by_side=True is for learners on the CPU, these are on {device}: two threads would wait for one "
            "device, and could not be captured in its graphs; leave it out"
        )
    if (place := env.design_spec.space.low.device) != device:
        raise ValueError(
            f"the learners are on {device}, the tensors of the bodies on {place}, and Eq. 5 would meet designs from "
            f"elsewhere; make both environments with device={str(device)!r}"
        )
    return device


def check_networks(
    env: MorphEnv, population: SACLearner, individual: SACLearner, dynamics: DynamicsLearner | None
) -> None:
    """Refuse networks that do not fit the bodies, and those of two learners that cannot start from each other."""
    sizes, wanted = _sizes(env), env.observation_spec["observation"].dtype
    state, body = sizes["observation"], sizes["design"]
    for name, learner in (("population", population), ("individual", individual)):
        policy, qvalue = learner.policy.network.mlp, learner.qvalue.module.mlp
        found = policy.in_features, policy.out_features, qvalue.in_features
        if found != (state + body, 2 * sizes["action"], sum(sizes.values())):
            raise ValueError(
                f"the networks of {name} are not for bodies of sizes {sizes}: the policy turns {found[0]} numbers into "
                f"{found[1]}, the critics read {found[2]}; make them with make_policy(env) and make_qvalue(env)"
            )
    for name, trained in {"population": population, "individual": individual, "dynamics": dynamics}.items():
        if trained is not None:
            trained.check_networks_lie_here()
        if trained is not None and (dtype := trained.weights_by_run()[0].dtype) != wanted:
            raise ValueError(f"the weights of {name} are {dtype}, the bodies observe in {wanted}; leave them in that")
    check_exchangeable((individual.policy, individual.qvalue), (population.policy, population.qvalue))
    if dynamics is not None:
        _check_model(env, dynamics.ensemble)


def check_buffers(env: MorphEnv, buffers: Buffers, *, imagined_rows: int) -> None:
    """Refuse buffers that are one, are for other runs, live apart, or are too small for what is stored at once."""
    parts = {field.name: getattr(buffers, field.name) for field in fields(buffers)}
    if len({id(buffer) for buffer in parts.values()}) < len(parts):
        raise ValueError(
            "two of the buffers are one, and emptying one would empty the other; make four, with Buffers.for_env(env)"
        )
    runs, device = env.batch_size.numel(), buffers.pop.storage.device
    least = {"pop": env.episode_steps, "ind": env.episode_steps, "s0": 1, "art": imagined_rows}
    for name, buffer in parts.items():
        if buffer.num_runs != runs:
            raise ValueError(f"buffer {name} is for {buffer.num_runs} run(s), the bodies have {runs}; make it for them")
        if buffer.capacity < least[name]:
            raise ValueError(
                f"buffer {name} has room for {buffer.capacity} rows, and {least[name]} come at once; enlarge it"
            )
        if buffer.storage.device != device:
            raise ValueError(
                f"buffer pop is on {device}, {name} on {buffer.storage.device}; make all buffers on one device"
            )


def _sizes(env: MorphEnv | WorldModelEnv) -> dict[str, int]:
    return {
        "observation": env.observation_spec["observation"].shape[-1],
        "action": env.action_spec.shape[-1],
        "design": env.design_spec.shape[-1],
    }


def _check_model(env: MorphEnv, model: object) -> None:
    """Refuse a model of other bodies, or of other runs; one that is not known here is believed."""
    if isinstance(model, SimulatorDynamics) and type(model.bodies) is not type(env):
        raise ValueError(
            f"the dream simulates a {type(model.bodies).__name__}, the bodies are of {type(env).__name__}; simulate "
            "those"
        )
    if not isinstance(model, GaussianEnsemble):
        return
    sizes, runs, network = _sizes(env), env.batch_size.numel(), model.network
    found = network.in_features, network.out_features, model.num_runs or 1
    if found != (sum(sizes.values()), 2 * sizes["observation"], runs):
        raise ValueError(
            f"the ensemble is not for {runs} run(s) of bodies of sizes {sizes}: it has {found[2]} and turns {found[0]} "
            f"numbers into {found[1]}; make it with GaussianEnsemble.for_env(env)"
        )


def check_dream(
    env: MorphEnv,
    dynamics: DynamicsLearner | None,
    dream: WorldModelEnv | None,
    generator: DesignGenerator | None,
    first_designs: Tensor,
) -> None:
    """Refuse a dream of which nothing is learnt, that pays otherwise than the bodies, or is asked for no bodies."""
    if (dream is None) != (generator is None):
        raise ValueError("imagining needs both a dream and a generator; give both, or neither for the baseline")
    if dream is None or generator is None:
        return
    if not isinstance(dream, WorldModelEnv):
        raise TypeError(
            f"the dream is a {type(dream).__name__}, and imagination asks its model itself; pass a WorldModelEnv, "
            "which of a TransformedEnv is its base_env"
        )
    model = dream.ensemble
    if isinstance(model, GaussianEnsemble):
        if dynamics is not None and model is not dynamics.ensemble:
            raise ValueError(
                "the dream steps another ensemble than the one that dynamics trains; make it with dynamics.ensemble"
            )
        if dynamics is None and not model.inputs.count.any():
            raise ValueError(
                "the dream steps an ensemble that has seen nothing and that nobody trains; give its learner as dynamics"
            )
    _check_rewards(env, dream)
    _check_model(env, model)
    _check_generator(env, generator, first_designs)


def check_imagined(
    env: MorphEnv, dream: WorldModelEnv | None, *, imagined_states: str, value_states: str, anchored: bool
) -> None:
    """Refuse to match states of bodies that cannot tell how high they stand, and to anchor with a model that cannot.

    Raises:
        ValueError: of `coim.envs.kinematics`, if the bodies' lengths are not known as functions of their designs.
        TypeError: if the model has no ``means``.
    """
    if "matched" in (imagined_states, value_states):
        observation, unit = env.observation_spec["observation"].zero(), torch.ones_like(env.design_spec.space.low)
        env.transfer(observation, unit, unit)
    if anchored and dream is not None and not isinstance(dream.ensemble, AnchoredDynamics):
        raise TypeError(
            f"a {type(dream.ensemble).__name__} has no means() to anchor with; give it one as AnchoredDynamics has it, "
            "or leave anchored out"
        )


def _check_rewards(env: MorphEnv, dream: WorldModelEnv) -> None:
    """Compare the rewards of dream and bodies on a few rows that stand for all."""
    sizes = _sizes(env), _sizes(dream)
    if sizes[0] != sizes[1]:
        raise ValueError(f"the dream has sizes {sizes[1]}, the bodies {sizes[0]}; make the dream of these bodies")
    rng = torch.Generator("cpu").manual_seed(0)
    observation, action, following, design = (
        torch.randn(TRIES, sizes[0][key], generator=rng, dtype=torch.float32, device="cpu").to(env.device or "cpu")
        for key in ("observation", "action", "observation", "design")
    )
    row = (observation, action.tanh(), following, design.sigmoid() + 0.5)
    if not torch.allclose(dream.reward_fn(*row), env.reward_fn(*row)):
        raise ValueError(
            "the dream pays other rewards than the bodies: it was made of another body or task; make it of this env"
        )


def _check_generator(env: MorphEnv, generator: DesignGenerator, first_designs: Tensor) -> None:
    """Try G on the first designs and on two corners; torch's global generators stay as they are."""
    if not callable(generator):
        raise TypeError(f"the generator is a {type(generator).__name__}; pass a DesignGenerator, such as NoisyDesigns")
    low, high = env.design_spec.space.low, env.design_spec.space.high
    tried = torch.cat([first_designs, low[None], high[None]]).repeat(TRIES, 1)
    tried = tried.unsqueeze(1).expand(-1, env.batch_size.numel(), -1)  # [N, K, D]
    with torch.random.fork_rng(devices=[tried.device] if tried.device.type == "cuda" else []):
        found = generator(tried.clone(), rng=torch.Generator(tried.device).manual_seed(0))
    if found.shape != tried.shape:
        raise ValueError(
            f"the generator makes designs {list(found.shape)} of designs {list(tried.shape)}; it must keep their shape"
        )
    if found.dtype != tried.dtype or found.device != tried.device:
        raise ValueError(
            f"the generator makes designs in {found.dtype} on {found.device}, of designs in {tried.dtype} on "
            f"{tried.device}; it must keep both"
        )
    outside = ~((low <= found) & (found <= high)).all(-1)  # NaN is neither
    if outside.any():
        raise ValueError(
            f"the generator makes {found[outside][0].tolist()} of {tried[outside][0].tolist()}, which leaves "
            f"[{low.tolist()}, {high.tolist()}]; let it end with design_spec.project()"
        )


def check_search(env: MorphEnv, search: DesignSearch) -> None:
    """Refuse a search among designs that these bodies cannot have; one that does not say where it looks is believed."""
    if isinstance(search, type) or not callable(getattr(search, "maximise", None)):
        what = f"the class {search.__name__}" if isinstance(search, type) else f"a {type(search).__name__}"
        raise TypeError(f"search is {what}; pass a DesignSearch, such as ParticleSwarm(env.design_spec, seed=0)")
    spec: Bounded | None = getattr(search, "spec", None)
    if spec is None:
        return
    own, theirs = env.design_spec.space, spec.space
    alike = spec.shape == env.design_spec.shape and theirs.low.device == own.low.device
    if not alike or (theirs.low < own.low).any() or (theirs.high > own.high).any():
        raise ValueError(
            f"the search looks among designs of [{theirs.low.tolist()}, {theirs.high.tolist()}] on "
            f"{theirs.low.device}, the bodies have those of [{own.low.tolist()}, {own.high.tolist()}] on "
            f"{own.low.device}; make it with env.design_spec"
        )


def check_first_designs(env: MorphEnv, first_designs: Tensor) -> None:
    """Refuse first designs that the bodies or the networks could not take, of which the last is built hours later."""
    spec, low, high = env.design_spec, env.design_spec.space.low, env.design_spec.space.high
    if first_designs.ndim != 2 or first_designs.shape[1:] != spec.shape or not len(first_designs):
        raise ValueError(
            f"first_designs has shape {list(first_designs.shape)}, expected [I, {spec.shape[0]}] with at least one row"
        )
    if first_designs.device != low.device or first_designs.dtype != spec.dtype:
        raise ValueError(
            f"first_designs are {first_designs.dtype} on {first_designs.device}, the bodies take {spec.dtype} on "
            f"{low.device}; move them by first_designs.to({str(low.device)!r}, {spec.dtype})"
        )
    if not ((low <= first_designs) & (first_designs <= high)).all():
        raise ValueError(f"a first design of {first_designs.tolist()} leaves [{low.tolist()}, {high.tolist()}]")
