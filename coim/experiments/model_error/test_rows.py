"""What a model is tested on: rows that it never learns from, with the simulator's own next observation.

Shapes: T steps, R rows, K runs, M designs never built, S observation, D design.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Sec. 6.4 and Fig. 4(a).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from coim.designs import DesignGenerator
from coim.envs import MorphEnv
from coim.episode import run_episode
from coim.experiments.model_error.placed_simulator import PlacedSimulator
from coim.models import Policy, select_run

NEVER_BUILT = 8  # designs: uniform draws, the same in the whole run and for all seeds
KEPT = (("observation",), ("design",), ("action",), ("next", "observation"), ("next", "terminated"))


class Probes:
    """Collect rows on bodies of their own; they reach no replay and no generator of the run that is measured.

    Args:
        body: class of the environment.
        num_runs: K.
        episode_steps: T, steps of a trajectory.
        num_rows: R, rows kept of each collection.
        num_threads: native threads of the simulations.
        device: where the policies live.
    """

    def __init__(
        self,
        body: type[MorphEnv],
        *,
        num_runs: int,
        episode_steps: int,
        num_rows: int,
        num_threads: int = 1,
        device: torch.device | str | None = None,
    ) -> None:
        self.num_rows = num_rows
        self.env, self.strangers = (
            body(num_runs=count, episode_steps=episode_steps, num_threads=num_threads, device=device, seed=0)
            for count in (num_runs, NEVER_BUILT)
        )
        self.simulator = PlacedSimulator(body, num_threads=num_threads)
        low, high = body.design_bounds()
        uniform = torch.rand(NEVER_BUILT, body.DESIGN_SIZE, generator=torch.Generator().manual_seed(0))
        self.never_built = (low.float() + (high - low).float() * uniform).to(device)

    def trajectory(self, policy: Policy, design: Tensor, *, seed: int) -> TensorDict:
        """Rows ``[R, K]`` of one episode of each run's design ``[K, D]``, with sampled actions as in training."""
        rng = self._begin(self.env, seed)
        return self._thinned(run_episode(self.env, policy, design=design, rng=rng), rng)

    def unseen_trajectories(self, policy: Policy, *, seed: int) -> TensorDict:
        """Rows ``[R, K]`` of the designs that are never built, each run's policy on all of them."""
        found = []
        for run in range(self.env.numel()):
            rng = self._begin(self.strangers, seed + run)
            own = policy if self.env.numel() == 1 else select_run(policy, run)
            rows = run_episode(self.strangers, own, design=self.never_built, rng=rng)
            found.append(self._thinned(rows.reshape(-1), rng))
        return torch.stack(found, 1)

    def swapped(self, rows: TensorDictBase, generator: DesignGenerator, *, seed: int) -> tuple[TensorDict, Tensor]:
        """Put stored states under another design, as imagination does when G is not the identity.

        Args:
            rows: ``[N, K]``, of which R are drawn.
            generator: G.
            seed: seeds the draws.

        Returns:
            Rows ``[R, K]``, with the simulator's next observation of that state and body; and which of these states are
            impossible, ``[R, K]`` bool.
        """
        rng = torch.Generator(rows["design"].device).manual_seed(seed)
        chosen = self._thinned(rows, rng)
        chosen["design"] = generator(chosen["design"], rng=rng)
        flat = chosen.reshape(-1)
        truth = self.simulator.step(flat["observation"], flat["action"], flat["design"])
        shape = chosen.batch_size
        chosen["next", "observation"] = truth.next_observation.reshape(*shape, -1)
        chosen["next", "terminated"] = truth.broken.reshape(*shape, 1)
        return chosen, truth.impossible.reshape(shape)

    def _begin(self, env: MorphEnv, seed: int) -> torch.Generator:
        env.set_seed(seed)
        return torch.Generator().manual_seed(seed)

    def _thinned(self, rows: TensorDictBase, rng: torch.Generator) -> TensorDict:
        """Draw R of the rows along the first dimension, or all if there are fewer, with the keys that a test needs."""
        chosen = torch.randperm(len(rows), generator=rng, device=rng.device)[: self.num_rows]
        return rows.select(*KEPT)[chosen].clone()


def joined(parts: Sequence[TensorDictBase]) -> TensorDict:
    """Rows of several collections, one after the other."""
    return torch.cat(list(parts))
