"""A tiny environment whose dynamics a hand can compute, for tests that need specs or transitions but no simulator."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase


class ToyEnv(EnvBase):
    """Linear dynamics with a body: ``next = 0.9 observation + design_0 * action + design_1 * 0.1`` (entry by entry).

    Three observations, two designs in [0.5, 2], two actions in [-1, 1] (the third observation gets none of them).
    """

    batch_locked = True
    angle_indices: tuple[int, ...] = ()

    def __init__(self, *, num_runs: int = 1, episode_steps: int = 5) -> None:
        super().__init__(batch_size=[num_runs])
        self.design_spec = Bounded(0.5, 2.0, shape=(2,))
        design = Bounded(0.5, 2.0, shape=(num_runs, 2))
        self.observation_spec = Composite(observation=Unbounded((num_runs, 3)), design=design.clone(), shape=[num_runs])
        self.state_spec = Composite(design=design.clone(), shape=[num_runs])
        self.action_spec = Bounded(-1.0, 1.0, shape=(num_runs, 2))
        self.reward_spec = Unbounded((num_runs, 1))
        flag = Binary(1, shape=(num_runs, 1), dtype=torch.bool)
        self.full_done_spec = Composite(
            done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=[num_runs]
        )
        self.episode_steps = episode_steps
        self.steps = torch.zeros(num_runs, 1, dtype=torch.long)
        self.design = torch.ones(num_runs, 2)
        self.generator = torch.Generator().manual_seed(0)

    @staticmethod
    def dynamics(observation: Tensor, action: Tensor, design: Tensor) -> Tensor:
        """The next observation, for any batch."""
        push = torch.nn.functional.pad(action, (0, 1))
        return 0.9 * observation + design[..., :1] * push + 0.1 * design[..., 1:]

    @staticmethod
    def reward_fn(observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor) -> Tensor:
        """Minus the squared distance of the next observation from the origin."""
        return -next_observation.square().sum(-1, keepdim=True)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDict:
        if tensordict is not None and "design" in tensordict:
            self.design = tensordict["design"].clone()
        self.steps.zero_()
        self.observation = torch.rand(*self.batch_size, 3, generator=self.generator)
        return TensorDict({"observation": self.observation, "design": self.design}, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        before, action = tensordict["observation"], tensordict["action"]
        after = self.dynamics(before, action, self.design)
        self.steps += 1
        truncated = self.steps >= self.episode_steps
        out = {
            "observation": after,
            "design": self.design,
            "reward": self.reward_fn(before, action, after, self.design),
        }
        out |= {"done": truncated, "truncated": truncated, "terminated": torch.zeros_like(truncated)}
        return TensorDict(out, self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(seed or 0)


def random_rows(*batch: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> TensorDict:
    """Random transitions of a ToyEnv in the schema of all buffers, ``[*batch]``."""
    g = torch.Generator().manual_seed(seed)

    def normal(size: int) -> Tensor:
        return torch.randn(*batch, size, generator=g, dtype=dtype)

    observation, action = normal(3), normal(2).tanh()
    design = torch.rand(*batch, 2, generator=g, dtype=dtype) + 0.5
    after = ToyEnv.dynamics(observation, action, design) + 0.1 * normal(3)
    terminated = torch.rand(*batch, 1, generator=g) < 0.3
    truncated = torch.rand(*batch, 1, generator=g) < 0.3
    return TensorDict(
        {
            "observation": observation,
            "action": action,
            "design": design,
            "next": {
                "observation": after,
                "design": design,
                "reward": normal(1),
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            },
        },
        batch,
    )
