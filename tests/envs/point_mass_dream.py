"""A dream of a mass on a line, whose law a hand can compute."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import (
    EnvBase,
)

from coim.envs.world_model import WorldModelEnv


class PointMass(EnvBase):
    """A mass ``design[0]`` on a line, pushed by the action; paid for its speed."""

    def __init__(self, num_runs: int = 1) -> None:
        super().__init__(batch_size=[num_runs])
        self.design_spec = Bounded(low=0.5, high=2.0, shape=(2,))
        observed = {"observation": Unbounded((num_runs, 3)), "design": self.design_spec.expand(num_runs, 2)}
        self.observation_spec = Composite(observed, shape=(num_runs,))
        self.state_spec = Composite(design=self.design_spec.expand(num_runs, 2), shape=(num_runs,))
        self.action_spec = Bounded(low=-1.0, high=1.0, shape=(num_runs, 1))
        self.reward_spec = Unbounded((num_runs, 1))
        flag = Binary(shape=(num_runs, 1), dtype=torch.bool)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=(num_runs,))

    @staticmethod
    def reward_fn(observation: Tensor, action: Tensor, next_observation: Tensor, design: Tensor) -> Tensor:
        return next_observation[..., 1:2] - 0.1 * action.square()

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: object) -> TensorDictBase:
        return self.observation_spec.zero().update(self.full_done_spec.zero())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise NotImplementedError

    def _set_seed(self, seed: int | None) -> None:
        pass


class Physics:
    """The point mass's own law, and a third entry that is noise."""

    def sample(
        self, observation: Tensor, action: Tensor, design: Tensor, *, generator: torch.Generator | None = None
    ) -> Tensor:
        place, speed = observation[..., :1], observation[..., 1:2]
        noise = torch.randn(place.shape, generator=generator, dtype=place.dtype)
        return torch.cat([place + 0.1 * speed, speed + 0.1 * action / design[..., :1], noise], -1)


def make_dream(*batch_size: int, num_runs: int = 1, seed: int | None = 0) -> WorldModelEnv:
    return WorldModelEnv(Physics(), PointMass(num_runs), batch_size=batch_size, seed=seed)


def start_of(*batch_size: int, seed: int = 0) -> TensorDict:
    rng = torch.Generator().manual_seed(seed)
    observation = torch.randn(*batch_size, 3, generator=rng)
    return TensorDict(
        {"observation": observation, "design": 0.5 + torch.rand(*batch_size, 2, generator=rng)}, batch_size
    )
