"""A run's folder, opened for a script: the networks, the bodies they move, and the designs that were tried.

Shapes: T steps, K runs, D design.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from coim.checkpoints import files_complaint, newest_whole, read_notes, read_state
from coim.envs import BODIES, MorphEnv
from coim.envs.native_episode import can_be_native
from coim.episode import run_episode
from coim.learners.flat_weights import read_networks
from coim.models import GaussianEnsemble, NetworkSizes, Policy, QValue, select_run
from coim.run_folder import TriedDesign, policy_path, read_config, read_designs

NetworkT = TypeVar("NetworkT", bound=nn.Module)


@dataclass(frozen=True, eq=False)
class Agent:
    """Networks that belong together.

    Attributes:
        policy: ``pi(a | s, xi)``.
        qvalue: the critics ``Q(s, a, xi)``.

    Example:
        >>> from coim import HopperMorph, make_policy, make_qvalue
        >>> env = HopperMorph(num_runs=3, seed=0)
        >>> agent = Agent(make_policy(env), make_qvalue(env))
        >>> agent.qvalue(agent.policy(env.reset()))["state_action_value"].shape  # of three rows, by both critics
        torch.Size([3, 2])
    """

    policy: Policy
    qvalue: QValue


@dataclass(frozen=True, eq=False)
class TrainedBody:
    """A body that a run has tried, with the policy of its best evaluation.

    Attributes:
        tried: the design ``[D]``, its number, and the return of that evaluation.
        policy: the individual policy that earned it, of one run.

    Example:
        >>> from coim import HopperMorph, make_policy
        >>> bodies = HopperMorph(seed=0, episode_steps=10)
        >>> tried = TriedDesign(0, 6, "optimised", torch.tensor([1.2, 0.8, 1.9, 0.6]), 31.5, best_return=910.0)
        >>> body = TrainedBody(tried, make_policy(bodies))
        >>> run_episode(bodies, body.policy, design=body.tried.design[None], deterministic=True).shape
        torch.Size([10, 1])
    """

    tried: TriedDesign
    policy: Policy


@dataclass(frozen=True, eq=False)
class SavedRun:
    """What became of a run, as `load_run` returns it.

    Attributes:
        folder: of the run.
        environment: name of the body.
        settings: every setting of ``config.json``, under its name of today.
        bodies: K of them, with the run's task and length of an episode, ready to be reset with designs.
        population: pi_Pop and Q_Pop, which serve every design.
        individual: pi_Ind and Q_Ind of the last design that has an episode in the checkpoint; see `policy_of` for the
            others.
        ensemble: p~; None in a run without one.
        designs: those whose episodes are all over, a row per run and design.
        run: the one that everything else is of; None where all K runs are stacked along the run axis.

    Example:
        >>> saved = load_run("runs/hopper-20260101-120000-run", run=0)  # doctest: +SKIP
        >>> saved.settings["chosen_by"], [tried.best_return for tried in saved.designs]  # doctest: +SKIP
        >>> best = saved.best.tried.design[None]  # doctest: +SKIP
        >>> rows = run_episode(saved.bodies, saved.population.policy, design=best)  # doctest: +SKIP
    """

    folder: Path
    environment: str
    settings: dict[str, Any]
    bodies: MorphEnv
    population: Agent
    individual: Agent
    ensemble: GaussianEnsemble | None
    designs: tuple[TriedDesign, ...]
    run: int | None

    @property
    def best(self) -> TrainedBody:
        """The design with the highest return, of all runs in the folder, with its policy.

        Raises:
            ValueError: if no design has a return yet, or its policy was not kept.

        Example:
            >>> best = load_run("runs/hopper-20260101-120000-run").best  # doctest: +SKIP
            >>> best.tried.design, best.policy  # doctest: +SKIP
        """
        return self.trained()

    def trained(self, number: int | None = None) -> TrainedBody:
        """A design of the run with its policy; of K runs, that of the run with the highest return on it.

        Args:
            number: of the design, from 1; None takes the one with the highest return.

        Raises:
            ValueError: if no such design has a return, or its policy was not kept.
        """
        best = self.highest(number)
        policy = self.policy_of(best.number)
        return TrainedBody(best, policy if policy.num_runs is None else select_run(policy, best.run))

    def highest(self, number: int | None = None) -> TriedDesign:
        """The design with the highest return, or that of a number in the run with the highest return on it.

        Raises:
            ValueError: if no such design has a return.
        """
        done = [tried for tried in self.designs if math.isfinite(tried.best_return)]
        if not done:
            raise ValueError(f"no design in {self.folder} has a return yet; wait for the next row of its designs.csv")
        asked = [tried for tried in done if number in (None, tried.number)]
        if not asked:
            there = sorted({tried.number for tried in done})
            raise ValueError(f"{self.folder} has no design {number} with a return: there are designs {there}")
        return max(asked, key=lambda tried: tried.best_return)

    def policy_of(self, number: int) -> Policy:
        """The individual policy to which a design owes its best return.

        Args:
            number: of the design, from 1; each of K stacked runs has its own design of that number.

        Raises:
            ValueError: if there is none of this number; those that there are, are named.
        """
        weights = self._best(number)["policy"]
        policy = NetworkSizes.among(self.settings | {"num_runs": self.bodies.numel()}).policy(self.bodies)
        if policy.num_runs is None:
            weights = {name: values[0] for name, values in weights.items()}
        policy.network.mlp.load_state_dict(weights)
        return policy.to(self.bodies.device)

    def rewind(self, number: int) -> Tensor:
        """Let the next reset of the bodies be the one before the best evaluation of a design.

        Returns:
            The design to reset them with, ``[K, D]``.
        """
        best = self._best(number)
        state = self.bodies.get_simulation_state()
        state["generator"] = best["start"]
        self.bodies.set_simulation_state(state)
        return best["design"].to(self.bodies.device)

    def best_episode(self, number: int) -> TensorDict:
        """The evaluation that gave a design its best return, once more.

        Args:
            number: of the design, from 1.

        Returns:
            Rows ``[T, K]`` in the transition schema. Their return is the run's on the machine that made it; elsewhere,
            or with one of K runs alone, products are rounded differently, which a gait may amplify.
        """
        design = self.rewind(number)
        return run_episode(
            self.bodies, self.policy_of(number), design=design, deterministic=True, native=self.acts_natively
        )

    @property
    def acts_natively(self) -> bool:
        """Whether the run's episodes were native code, where this machine can make it: others round differently.

        Those of a run that went on with the other kind are taken to be of the newest.
        """
        return bool(self.settings.get("native_episodes")) and can_be_native()

    def _best(self, number: int) -> dict[str, Any]:
        """What the run kept of a design's best evaluation, the rows of this run or of all, ``[K, ...]`` each."""
        path = policy_path(self.folder, number)
        if not path.is_file():
            there = sorted(int(path.stem.split("-")[1]) for path in path.parent.glob("design-*.pt"))
            raise ValueError(
                f"{self.folder} keeps no policy of design {number}: there are designs {there}, and "
                "population.policy serves any"
            )
        kept = torch.load(path, map_location="cpu", weights_only=True)
        return kept if self.run is None else _row(kept, self.run)


def load_run(
    folder: str | Path,
    *,
    run: int | None = None,
    body: type[MorphEnv] | None = None,
    device: torch.device | str = "cpu",
) -> SavedRun:
    """Open a run's folder, also while the run is still going on; nothing in it is changed.

    Networks are those of the newest checkpoint that is whole. If that is not the newest one, a warning says so.

    Args:
        folder: that a recipe wrote.
        run: one of K runs, which then has networks without a run axis and one body; None keeps all K.
        body: the environment; by default the one that ``config.json`` names.
        device: where the networks go, and the bodies' tensors.

    Raises:
        ValueError: if there is no run in the folder or no checkpoint of it yet, if all are damaged or of another
            version, if there is no such run, or if the environment's name is not known.

    Example:
        >>> run = load_run("runs/hopper-20260101-120000-run")  # doctest: +SKIP
        >>> best = max(run.designs, key=lambda design: design.best_return)  # doctest: +SKIP
        >>> run_episode(run.bodies, run.policy_of(best.number), design=best.design[None])  # doctest: +SKIP
    """
    folder = Path(folder)
    config = read_config(folder)
    settings, environment = config["settings"], config["environment"]
    body = body or BODIES.get(environment)
    if body is None:
        raise ValueError(f"{environment!r} is none of {', '.join(BODIES)}; give its class as body=")
    try:
        sizes = NetworkSizes.among(settings)
        given = {"task": settings["task"], "episode_steps": settings["episode_steps"]}
    except KeyError as error:
        raise ValueError(f"{folder} has no setting {error}; load it with the version in its config.json") from None
    if run is not None and not 0 <= run < sizes.num_runs:
        raise ValueError(f"run {run} is not in {folder}, which has runs 0 .. {sizes.num_runs - 1}")
    bodies = body(num_runs=sizes.num_runs if run is None else 1, seed=0, device=device, **given)

    def ready(network: NetworkT) -> NetworkT:
        alone = run is not None and sizes.stacked is not None
        return (select_run(network, cast(int, run)) if alone else network).to(device)

    def agent(state: dict[str, Any]) -> Agent:
        policy, qvalue = sizes.policy(bodies), sizes.qvalue(bodies)
        read_networks({"policy": policy.network.mlp, "qvalue": qvalue.module.mlp}, state)
        return Agent(ready(policy), ready(qvalue))

    state, ensemble = _last_state(folder), None
    if state["dynamics"] is not None:
        ensemble = sizes.ensemble(bodies)
        read_networks({"ensemble": ensemble.network}, state["dynamics"])
        ensemble.inputs.load_state_dict(state["dynamics"]["inputs"])
        ensemble.targets.load_state_dict(state["dynamics"]["targets"])
    return SavedRun(
        folder=folder,
        environment=environment,
        settings=settings,
        bodies=bodies,
        population=agent(state["population"]),
        individual=agent(state["individual"]),
        ensemble=None if ensemble is None else ready(ensemble),
        designs=tuple(design for design in read_designs(folder) if run in (None, design.run)),
        run=run,
    )


def _last_state(folder: Path) -> dict[str, Any]:
    """State of the algorithm in the newest checkpoint that is whole."""
    path, damaged = newest_whole(folder / "checkpoint", files_complaint)
    if path is None:
        raise ValueError(f"{folder} has no checkpoint yet: its run writes the first one when it has chosen a design")
    for worse, why in damaged.items():
        warnings.warn(f"{worse} is damaged ({why}); reading {path.name}", stacklevel=3)
    read_notes(path)
    return read_state(path, "algorithm", device="cpu")


def _row(state: dict[str, Any], run: int) -> dict[str, Any]:
    """One row of every tensor, its axis kept."""
    return {name: _row(v, run) if isinstance(v, dict) else v[run : run + 1] for name, v in state.items()}
