"""Parts that do not fit together are refused when Algorithm 1 is made, not when one of them is needed."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from small_algorithm import STEPS, dealt
from torch import Tensor
from torchrl.data import Bounded
from torchrl.envs import DoubleToFloat, TransformedEnv

from coim import (
    Buffers,
    CoAdaptation,
    DesignChoice,
    DynamicsLearner,
    EpisodeDone,
    GaussianEnsemble,
    GradientSearch,
    HalfCheetahMorph,
    HopperMorph,
    ImaginedReplay,
    KnownDesigns,
    ParticleSwarm,
    SACLearner,
    SimulatorDynamics,
    UpdatePlan,
    WalkerMorph,
    WorldModelEnv,
    make_policy,
    make_qvalue,
)
from coim.agreement import check_bodies, check_learners, check_model
from coim.imagined_replay import _check_rewards

ENV = HopperMorph(num_runs=2, episode_steps=STEPS, seed=0)
WALKER = WalkerMorph(num_runs=2, seed=0)


def learner(num_runs: int | None = 2) -> SACLearner:
    """A tiny one for hoppers."""
    policy = make_policy(ENV, num_cells=(4,), num_runs=num_runs)
    return SACLearner(policy, make_qvalue(ENV, num_cells=(4,), num_runs=num_runs), num_runs=num_runs)


def sharing(name: str) -> dict[str, SACLearner]:
    """Two learners with one policy, or one pair of critics."""
    one, other = learner(), learner()
    both = {"policy": one.policy, "qvalue": one.qvalue, name: getattr(other, name)}
    return {"population": other, "individual": SACLearner(*both.values(), num_runs=2)}


def ensemble(num_runs: int | None = 2, *, env: HopperMorph | WalkerMorph = ENV) -> GaussianEnsemble:
    """A tiny one, for hoppers unless said otherwise."""
    return GaussianEnsemble.for_env(env, num_cells=(4,), num_runs=num_runs)


def dreaming(**parts: Any) -> dict[str, Any]:
    """All that imagination needs, with some of it exchanged."""
    learnt = ensemble()
    dream = WorldModelEnv(learnt, ENV, batch_size=[2])
    return {"dynamics": DynamicsLearner(learnt, num_runs=2), "dream": dream, "generator": KnownDesigns()} | parts


def algorithm(**parts: Any) -> CoAdaptation:
    """Two runs of the baseline, with some parts exchanged."""
    given: dict[str, Any] = {
        "evaluation_env": HopperMorph(num_runs=2, episode_steps=STEPS, seed=1),
        "population": learner(),
        "individual": learner(),
        "buffers": parts.get("buffers", buffers()),
    }
    choosing, learning, imagining, rest = dealt(parts, DesignChoice, UpdatePlan, ImaginedReplay, CoAdaptation)
    search = GradientSearch(ENV.design_spec, num_starts=2, num_steps=2, seed=0)
    chosen: dict[str, Any] = {"spec": ENV.design_spec, "first_designs": torch.ones(1, 4), "search": search}
    updates = {"individual_updates": 2, "population_updates": 2, "model_updates": 2}
    if imagining:
        given["imagined"] = ImaginedReplay(**{"art": given["buffers"].art} | imagining)
    given |= {"design_choice": DesignChoice(**chosen | choosing), "updates": UpdatePlan(**updates | learning)}
    return CoAdaptation(ENV, **given | rest)


def beyond(design: Tensor, *, rng: torch.Generator | None = None) -> Tensor:
    """A G with noise and no bounds."""
    return design + 0.3 * torch.randn(design.shape, generator=rng)


def flat(design: Tensor, *, rng: torch.Generator | None = None) -> Tensor:
    """A G that loses the run axis."""
    return design.flatten(0, 1)


def unlike(**settings: Any) -> HopperMorph:
    """Evaluation bodies that differ in one setting."""
    return HopperMorph(**{"num_runs": 2, "episode_steps": STEPS, "seed": 1} | settings)


def dream_of(**settings: Any) -> dict[str, Any]:
    """A dream that was made of other bodies than those of training."""
    learnt = ensemble()
    dream = WorldModelEnv(learnt, HopperMorph(num_runs=2, seed=0, **settings), batch_size=[2])
    return dreaming(dynamics=DynamicsLearner(learnt, num_runs=2), dream=dream)


def walking_dream() -> dict[str, Any]:
    """A dream of another body, sizes and all."""
    parts = dreaming()
    return parts | {"dream": WorldModelEnv(parts["dynamics"].ensemble, WALKER, batch_size=[2])}


def sized(num_cells: int = 4, *, env: HopperMorph | WalkerMorph = ENV, scaled: bool = True) -> SACLearner:
    """A learner with other layers, for other bodies, or without scaling."""
    policy, qvalue = (make(env, num_cells=(num_cells,), num_runs=2) for make in (make_policy, make_qvalue))
    if not scaled:
        policy.network.scaling = qvalue.module.scaling = None
    return SACLearner(policy, qvalue, num_runs=2)


def double() -> SACLearner:
    """A learner in float64."""
    policy, qvalue = (make(ENV, num_cells=(4,), num_runs=2).double() for make in (make_policy, make_qvalue))
    return SACLearner(policy, qvalue, num_runs=2)


def buffers(*, num_runs: int = 2, **capacities: int) -> Buffers:
    """Buffers in which all but some capacities suffice."""
    capacity = {"pop_capacity": 90, "ind_capacity": 90, "s0_capacity": 9, "art_capacity": 102} | capacities
    return Buffers.for_env(HopperMorph(num_runs=num_runs, seed=0), **capacity, seed=0)


def one_for_two() -> Buffers:
    """Replay_Ind is Replay_Pop, which every new design would empty."""
    made = buffers()
    return Buffers(pop=made.pop, ind=made.pop, s0=made.s0, art=made.art)


def simulated_dream(bodies: type[HopperMorph] | type[WalkerMorph]) -> dict[str, Any]:
    """The simulator imagines."""
    return dreaming(dream=WorldModelEnv(SimulatorDynamics(bodies(num_runs=2, seed=0)), ENV, batch_size=[2]))


def one_for_both() -> dict[str, SACLearner]:
    """The same learner twice."""
    return dict.fromkeys(("population", "individual"), learner())


REFUSED: dict[str, tuple[Callable[[], dict[str, Any]], str]] = {
    "precision": (lambda: {"precision": "bf16"}, "precision='bf16' is unknown; choose 'float32' or 'bfloat16'"),
    "one environment": (lambda: {"evaluation_env": ENV}, "env and evaluation_env are one environment"),
    "another body": (
        lambda: {"evaluation_env": WalkerMorph(num_runs=2, seed=1)},
        "evaluation_env is a WalkerMorph, env a HopperMorph",
    ),
    "another task": (
        lambda: {"evaluation_env": unlike(task="backward")},
        "evaluation_env has task backward, env has forward",
    ),
    "fewer runs": (
        lambda: {"evaluation_env": unlike(num_runs=1)},
        r"evaluation_env has batch size \[1\], env has \[2\]",
    ),
    "one learner": (one_for_both, "population and individual are one learner"),
    "one policy": (lambda: sharing("policy"), "population and individual share their policy"),
    "one critic": (lambda: sharing("qvalue"), "population and individual share their qvalue"),
    "no run axis": (
        lambda: {"individual": learner(None)},
        r"individual has num_runs=None, the bodies have 2 run\(s\); make .* num_runs=2",
    ),
    "too many runs": (lambda: {"population": learner(3)}, "population has num_runs=3"),
    "a model without run axis": (
        lambda: dreaming(dynamics=DynamicsLearner(ensemble(None))),
        "dynamics has num_runs=None",
    ),
    "learners for another body": (
        lambda: {name: sized(env=WALKER) for name in ("population", "individual")},
        r"the networks of population are not for bodies of sizes .*: the policy turns 25 numbers into 12, the critics",
    ),
    "learners in double": (
        lambda: {"population": double(), "individual": double()},
        "the weights of population are torch.float64, the bodies observe in torch.float32",
    ),
    "learners of two sizes": (lambda: {"individual": sized(5)}, "the Policy of one learner has weights of shapes"),
    "learners that scale otherwise": (
        lambda: {"individual": sized(scaled=False)},
        "the two learners scale their inputs differently",
    ),
    "a model of another body": (
        lambda: {"dynamics": DynamicsLearner(ensemble(env=WALKER), num_runs=2)},
        "the ensemble is not for 2 .* of bodies of sizes .*: it has 2 and turns 31 numbers into 36",
    ),
    "a simulated dream of another body": (
        lambda: simulated_dream(WalkerMorph),
        "the dream simulates a WalkerMorph, the bodies are of HopperMorph",
    ),
    "one buffer for two": (lambda: {"buffers": one_for_two()}, "two of the buffers are one"),
    "buffers for other runs": (lambda: {"buffers": buffers(num_runs=3)}, r"buffer pop is for 3 run\(s\), .* have 2"),
    "less than an episode": (
        lambda: {"buffers": buffers(ind_capacity=STEPS - 1)},
        f"buffer ind has room for {STEPS - 1} rows, and {STEPS} come at once",
    ),
    "no room for what is imagined": (
        lambda: dreaming(buffers=buffers(art_capacity=101)),
        "buffer art has room for 101 rows, and 102 come at once",  # 2 updates with 51 imagined rows of 256
    ),
    "half an update": (lambda: {"model_updates": 0.5}, "model_updates is 0.5, it must be a whole number"),
    "NaN designs": (lambda: {"num_designs": float("nan")}, "num_designs is nan, it must be a whole number"),
    "G in double": (
        lambda: dreaming(generator=lambda design, rng=None: design.double()),
        "makes designs in torch.float64 on cpu, of designs in torch.float32",
    ),
    "imagining into another buffer": (lambda: dreaming(art=buffers().art), "into another buffer than buffers.art"),
    "a choice for other bodies": (
        lambda: {"spec": WALKER.design_spec, "first_designs": torch.ones(1, 7), "search": None, "bodies": "random"},
        r"design_choice chooses among designs of \[.*\] on cpu, the bodies have .*; make it with env\.design_spec",
    ),
    "a dream that nobody trains": (
        lambda: dreaming(dynamics=DynamicsLearner(ensemble(), num_runs=2)),
        r"another ensemble than the one that dynamics trains; make it with dynamics\.ensemble",
    ),
    "a dream that saw nothing": (lambda: dreaming(dynamics=None), "has seen nothing and that nobody trains"),
    "a dream of another task": (lambda: dream_of(task="backward"), "pays other rewards than the bodies"),
    "a dream of another body": (walking_dream, r"the dream has sizes \{'observation': 18"),
    "G leaves the bounds": (lambda: dreaming(generator=beyond), r"the generator makes \[.*\] of \[.*\], which leaves"),
    "G of another shape": (lambda: dreaming(generator=flat), r"makes designs \[96, 4\] of designs \[48, 2, 4\]"),
    "a search for another body": (
        lambda: {"search": GradientSearch(WalkerMorph(seed=0).design_spec, seed=0)},
        r"the search looks among designs of \[.*\] on cpu, the bodies have .*; make it with env\.design_spec",
    ),
    "a search in wider bounds": (
        lambda: {"search": ParticleSwarm(Bounded(0.5, 3.0, shape=(4,)), seed=0)},
        r"the search looks among designs of .*3\.0, 3\.0\]",
    ),
    "no first design": (lambda: {"first_designs": torch.ones(0, 4)}, "with at least one row"),
    "a first design of NaN": (lambda: {"first_designs": torch.full((1, 4), torch.nan)}, r"has nan as its entry 1 of 4"),
    "a first design beyond the bounds": (
        lambda: {"first_designs": torch.tensor([[1.0, 1.0, 1.0, 1.0], [1.0, 1.0, 9.0, 1.0]])},
        r"a first design has 9 as its entry 3 of 4, which must lie in \[0.5, 2\]",
    ),
    "double first designs": (
        lambda: {"first_designs": torch.ones(1, 4, dtype=torch.float64)},
        "are torch.float64 on cpu, the bodies take torch.float32",
    ),
    "first designs elsewhere": (
        lambda: {"first_designs": torch.ones(1, 4, device="meta")},
        r"on meta, the bodies take .* on cpu; move them by first_designs\.to\('cpu', torch\.float32\)",
    ),
}


@pytest.mark.parametrize(("parts", "sentence"), REFUSED.values(), ids=REFUSED)
def test_parts_that_do_not_fit_are_refused(parts: Callable[[], dict[str, Any]], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        algorithm(**parts())


def test_what_is_behind_transforms_is_refused() -> None:
    def behind(env: Any) -> TransformedEnv:
        return TransformedEnv(env, DoubleToFloat(in_keys=["observation"]))

    with pytest.raises(TypeError, match=r"evaluation_env is a TransformedEnv, .* pass a MorphEnv"):
        algorithm(evaluation_env=behind(unlike()))
    parts = dreaming()
    with pytest.raises(TypeError, match=r"the dream is a TransformedEnv, .* pass a WorldModelEnv"):
        algorithm(**parts | {"dream": behind(parts["dream"])})


def test_what_is_no_such_part_is_refused() -> None:
    for part, other in (("population", "a learner"), ("individual", None), ("buffers", {}), ("first_designs", [[1.0]])):
        with pytest.raises(TypeError, match=f"{part} is a {type(other).__name__}; pass a "):
            algorithm(**{part: other})
    for search, what in ((None, "a NoneType"), (ParticleSwarm, "the class ParticleSwarm")):
        with pytest.raises(TypeError, match=f"search is {what}; pass a DesignSearch"):
            algorithm(search=search)
    with pytest.raises(TypeError, match="the generator is a int; pass a DesignGenerator"):
        algorithm(**dreaming(generator=3))
    algorithm(search=None, bodies="random")


@pytest.mark.parametrize("which", ["population", "dynamics"])
def test_networks_that_were_moved_after_their_learner_was_made_are_refused(which: str) -> None:
    parts = {"population": learner()} | dreaming()
    parts["population"].policy.double().float()
    if which == "dynamics":
        parts["population"] = learner()
        parts["dynamics"].ensemble.double().float()
    with pytest.raises(RuntimeError, match=r"moved after .* learner was made; make the learner last"):
        algorithm(**parts)


def test_the_simulator_of_the_same_body_may_imagine() -> None:
    algorithm(**simulated_dream(HopperMorph))


def test_two_robots_of_one_class_that_are_drawn_otherwise_are_no_pair() -> None:
    printed = (0.29, 0.3, 0.188, 0.29, 0.3, 0.188)
    one, other = HalfCheetahMorph(seed=0), HalfCheetahMorph(seed=1, segment_lengths=printed)
    with pytest.raises(ValueError, match="evaluation_env has another geom_size than env; make both alike"):
        check_bodies(one, other)
    with pytest.raises(ValueError, match="the dream's bodies have another geom_size than env; make both alike"):
        check_model(one, SimulatorDynamics(other))
    check_bodies(other, HalfCheetahMorph(seed=0, segment_lengths=printed))
    with pytest.raises(ValueError, match=r"another number of observed entries \(17, not 18\) than env"):
        check_bodies(WalkerMorph(seed=0), WalkerMorph(seed=1, observe_root_x=False))


def test_a_search_within_narrower_bounds_and_one_that_says_nothing_are_taken() -> None:
    algorithm(search=GradientSearch(Bounded(0.9, 1.1, shape=(4,)), seed=0))
    algorithm(search=SimpleNamespace(maximise=lambda fitness: (torch.ones(4), 0.0)))


def test_trying_g_moves_no_generator_that_others_draw_from() -> None:
    def heedless(design: Tensor, *, rng: torch.Generator | None = None) -> Tensor:
        return design + 0 * torch.rand(design.shape)

    parts = dreaming()
    before = torch.random.get_rng_state()
    art = buffers().art
    ImaginedReplay(art, parts["dream"], heedless).check_fits(ENV, art, parts["dynamics"], torch.ones(1, 4))
    assert torch.equal(torch.random.get_rng_state(), before)


def test_an_ensemble_that_has_learnt_elsewhere_may_be_dreamt_of_without_a_learner() -> None:
    learnt = ensemble()
    learnt.update_statistics(ENV.rollout(4).transpose(0, 1))
    algorithm(**dreaming(dynamics=None, dream=WorldModelEnv(learnt, ENV, batch_size=[2])))


def test_learners_go_side_by_side_on_the_cpu_alone() -> None:
    def elsewhere() -> Any:
        weights = [torch.empty(2, device="meta")]
        return SimpleNamespace(num_runs=2, policy=object(), qvalue=object(), weights_by_run=lambda: weights)

    with pytest.raises(ValueError, match="side_by_side=True is for learners on the CPU, these are on meta"):
        check_learners(ENV, elsewhere(), elsewhere(), None, side_by_side=True)
    with pytest.raises(ValueError, match=r"on meta, the tensors of the bodies on cpu, .* with device='meta'"):
        check_learners(ENV, elsewhere(), elsewhere(), None, side_by_side=False)
    with pytest.raises(ValueError, match="population is on meta, dynamics on cpu"):
        check_learners(ENV, elsewhere(), elsewhere(), DynamicsLearner(ensemble(), num_runs=2), side_by_side=False)


def test_a_fleet_of_one_run_searches_for_its_body() -> None:
    torch.manual_seed(0)
    env, evaluation_env = (HopperMorph(episode_steps=STEPS, seed=seed) for seed in (0, 1))
    buffers = Buffers.for_env(env, pop_capacity=90, ind_capacity=90, s0_capacity=9, art_capacity=9, seed=0)
    made = CoAdaptation(
        env,
        evaluation_env,
        population=learner(1),
        individual=learner(1),
        buffers=buffers,
        design_choice=DesignChoice(
            env.design_spec,
            torch.ones(1, 4),
            search=GradientSearch(env.design_spec, num_starts=2, num_steps=2, seed=0),
        ),
        num_designs=2,
        first_episodes=1,
        episodes=1,
        updates=UpdatePlan(individual_updates=1, population_updates=1, batch_size=4),
    )
    assert [event.kind for event in made if isinstance(event, EpisodeDone)] == ["first", "optimised"]


class Rooted(HopperMorph):
    """Is paid the root of its height, which made-up states do not all have."""

    @staticmethod
    def reward(
        observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor, task: str = "forward"
    ) -> Tensor:
        sign = 1 if task == "forward" else 2
        return sign * next_observation[..., :1].sqrt()


def test_rewards_that_are_no_number_in_made_up_states_are_compared_in_the_others() -> None:
    env = Rooted(num_runs=2, seed=0)
    for task, agrees in (("forward", True), ("backward", False)):
        dream = WorldModelEnv(ensemble(), Rooted(num_runs=2, seed=0, task=task), batch_size=[2])
        with nullcontext() if agrees else pytest.raises(ValueError, match="pays other rewards than the bodies"):
            _check_rewards(env, dream)
