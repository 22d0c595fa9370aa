"""Check that the parts of Algorithm 1 fit together when they are put together.

Parts that do not fit would run for hours until one of them is needed, or to the end with wrong numbers. Each error
names the part, what it should be, and the way out. `coim.DesignChoice` and `coim.ImaginedReplay` check themselves.

Shapes: K runs, S observation, A action, D design.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from numbers import Integral

import numpy as np
import torch

from coim.buffers import Buffers
from coim.envs.morph import MorphEnv
from coim.envs.simulator_dream import SimulatorDynamics
from coim.envs.world_model import WorldModelEnv
from coim.governor import Governor
from coim.learners.dynamics import DynamicsLearner
from coim.learners.known_networks import check_exchangeable
from coim.learners.sac import SACLearner
from coim.models.ensemble import GaussianEnsemble


def check_counts(counts: Mapping[str, int], updates: Mapping[str, int]) -> None:
    """Refuse counts below 1, updates below 0, and numbers that are not whole; errors name them."""
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
    """Refuse an unknown word; an option's name is given with its word and the words that it knows."""
    for name, (word, known) in options.items():
        if word not in known:
            choices = ", ".join(repr(one) for one in known[:-1]) + f" or {known[-1]!r}"
            raise ValueError(f"{name}={word!r} is unknown; choose {choices}")


def check_kinds(parts: Mapping[str, tuple[object, *tuple[type, ...]]]) -> None:
    """Refuse a part that has none of the types behind it; an error asks for the first of them."""
    for name, (part, *kinds) in parts.items():
        if not isinstance(part, tuple(kinds)):
            raise TypeError(f"{name} is a {type(part).__name__}; pass a {kinds[0].__name__}")


def check_bodies(env: MorphEnv, evaluation_env: MorphEnv) -> None:
    """Refuse bodies behind transforms, and evaluation bodies that are those of training or have other rewards."""
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
    if different := _different(env, evaluation_env):
        raise ValueError(f"evaluation_env has another {different} than env; make both alike but for their seeds")


# Of a compiled body: arguments of a class may change them, such as the lengths of its segments at xi = 1.
BODY: tuple[str, ...] = (
    "geom_size",
    "geom_pos",
    "geom_quat",
    "geom_friction",
    "body_pos",
    "body_quat",
    "body_mass",
    "body_inertia",
)
BODY += ("jnt_range", "jnt_axis", "jnt_stiffness", "dof_damping", "dof_armature", "actuator_gear", "actuator_ctrlrange")


def _different(env: MorphEnv, other: MorphEnv) -> str | None:
    """What differs between two robots of one class, or None."""
    sizes = [bodies.observation_spec["observation"].shape[-1] for bodies in (env, other)]
    if sizes[0] != sizes[1]:
        return f"number of observed entries ({sizes[1]}, not {sizes[0]})"
    if env.step_seconds != other.step_seconds:
        return f"control step ({other.step_seconds:g} s, not {env.step_seconds:g} s)"
    unit = np.ones(env.DESIGN_SIZE)
    own, others = (bodies.simulations.body(unit).compile() for bodies in (env, other))
    return next((name for name in BODY if not np.array_equal(getattr(own, name), getattr(others, name))), None)


def check_learners(
    env: MorphEnv,
    population: SACLearner,
    individual: SACLearner,
    dynamics: DynamicsLearner | None,
    *,
    side_by_side: bool,
) -> torch.device:
    """Refuse learners that share weights, lack the run axis of the bodies, or are on different devices.

    Returns:
        Their device.
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
    sizes, wanted = sizes_of(env), env.observation_spec["observation"].dtype
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
        check_model(env, dynamics.ensemble)


def check_buffers(env: MorphEnv, buffers: Buffers, *, imagined_rows: int) -> None:
    """Refuse buffers that are shared, for other runs, on different devices, or too small for what is stored at once."""
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


def sizes_of(env: MorphEnv | WorldModelEnv) -> dict[str, int]:
    """Entries of an observation, an action and a design."""
    return {
        "observation": env.observation_spec["observation"].shape[-1],
        "action": env.action_spec.shape[-1],
        "design": env.design_spec.shape[-1],
    }


def check_model(env: MorphEnv, model: object) -> None:
    """Refuse a model of other bodies or other runs; a model of another class is not checked."""
    if isinstance(model, SimulatorDynamics) and type(model.bodies) is not type(env):
        raise ValueError(
            f"the dream simulates a {type(model.bodies).__name__}, the bodies are of {type(env).__name__}; simulate "
            "those"
        )
    if isinstance(model, SimulatorDynamics) and (what := _different(env, model.bodies)):
        raise ValueError(f"the dream's bodies have another {what} than env; make both alike but for their seeds")
    if not isinstance(model, GaussianEnsemble):
        return
    sizes, runs, network = sizes_of(env), env.batch_size.numel(), model.network
    found = network.in_features, network.out_features, model.num_runs or 1
    if found != (sum(sizes.values()), 2 * sizes["observation"], runs):
        raise ValueError(
            f"the ensemble is not for {runs} run(s) of bodies of sizes {sizes}: it has {found[2]} and turns {found[0]} "
            f"numbers into {found[1]}; make it with GaussianEnsemble.for_env(env)"
        )


def check_governed(governor: Governor | None, *learners: SACLearner) -> None:
    """Refuse a governor where the share of imagined rows decides nothing.

    Raises:
        ValueError: if a learner sums the means over real and over imagined rows.
    """
    if governor is not None and any(learner.loss.mix == "sum" for learner in learners):
        raise ValueError(
            "a governor sets the share of imagined rows, and with mix='sum' they count as much as all real ones, "
            "whatever their share; make the learners with mix='batch'"
        )


def check_transfer(env: MorphEnv) -> None:
    """Refuse to match states of bodies that cannot tell how high they stand.

    Raises:
        ValueError: from `coim.envs.kinematics`, if the bodies' lengths are not known as functions of their designs.
    """
    observation, unit = env.observation_spec["observation"].zero(), torch.ones_like(env.design_spec.space.low)
    env.transfer(observation, unit, unit)
