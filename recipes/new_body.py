"""A body of your own: an XML file, the lengths that a design scales, and a reward.

The body here is a crawler, a torso between two stiff legs (`new_body.xml` beside this file). TorchRL checks it, and
then one policy is trained for all of its designs, another design in each episode. Everything else in `coim` takes it
too. Algorithm 1 on it is::

    from recipes import algorithm1
    from recipes.new_body import Crawler

    algorithm1.main(Crawler)

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Sec. 3 (the design as a context) and Eq. 3-4.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

import mujoco
import numpy as np
import torch
from torch import Tensor
from torchrl.envs import check_env_specs

from coim import (
    MorphEnv,
    RandomDesigns,
    SACLearner,
    TransitionBuffer,
    make_policy,
    make_qvalue,
    run_episode,
    sample_batches,
)

TORSO, LEG, RADIUS = 0.8, 0.5, 0.05  # m at xi = 1
FORWARD_VELOCITY = 4  # entry of the observation


class Crawler(MorphEnv):
    """A torso between two stiff legs, each turned by one motor at its hip.

    ======  =========  =========  ===========
    design  segment    at xi = 1  range of xi
    ======  =========  =========  ===========
    0       torso      0.80 m     0.5 - 2.0
    1       back leg   0.50 m     0.5 - 2.0
    2       front leg  0.50 m     0.5 - 2.0
    ======  =========  =========  ===========

    ===========  ====================================================  ==========
    observation  quantity                                              unit
    ===========  ====================================================  ==========
    0            height of the torso's centre above the floor          m
    1            pitch of the torso, wrapped to (-pi, pi]              rad
    2, 3         hips: back, front                                     rad
    4, 5         velocity of the torso, horizontal and vertical        m/s
    6            angular velocity of the torso                         rad/s
    7, 8         angular velocities of the hips: back, front           rad/s
    ===========  ====================================================  ==========

    The two actions are the torques of the hips, back and front, as shares of 100 N m. A step takes 0.02 s.
    """

    ASSET = str(Path(__file__).with_suffix(".xml"))
    DESIGN_SIZE = 3
    DESIGN_NAMES = ("torso", "back leg", "front leg")
    DESIGN_BOUNDS = (0.5, 2.0)
    FRAME_SKIP = 4
    RESET_NOISE = 0.01
    # Typical spread of each observation, by which networks divide: standard deviations under random actions, rounded.
    OBSERVATION_SCALE = (0.1, 0.5, 0.6, 0.6, 0.25, 0.25, 0.7, 1.2, 1.2)  # m, rad, m/s, rad/s
    FIRST_DESIGNS: ClassVar[tuple[tuple[float, ...], ...]] = ((1.0, 1.0, 1.0), (0.6, 1.5, 1.5), (1.5, 0.8, 1.2))
    EFFORT_COST = 0.1

    def shape_body(self, spec: mujoco.MjSpec, design: np.ndarray) -> None:
        """Set every length; the torso starts at the height of the longer leg."""
        torso, back, front = design * (TORSO, LEG, LEG)
        for name, side, length in (("back", -1, back), ("front", 1, front)):
            spec.body(name).pos = [side * torso / 2, 0.0, 0.0]
            spec.geom(name).fromto = [0.0, 0.0, 0.0, 0.0, 0.0, -length]
        spec.geom("torso").fromto = [-torso / 2, 0.0, 0.0, torso / 2, 0.0, 0.0]
        height = max(back, front) + RADIUS
        spec.body("torso").pos = [0.0, 0.0, height]
        for name in ("rootx", "rootz"):
            spec.joint(name).pos = [0.0, 0.0, -height]
        spec.joint("rootz").ref = height  # so that the first observation is the height above the floor

    @staticmethod
    def reward(
        observation: Tensor,
        action: Tensor,
        next_observation: Tensor,
        design: Tensor,
        task: Literal["forward", "backward"] = "forward",
    ) -> Tensor:
        """Speed in m/s less a tenth of the mean squared action, ``[*B, 1]``; the dream pays it too."""
        speed = next_observation[..., FORWARD_VELOCITY, None]
        effort = action.square().mean(-1, keepdim=True)
        return (speed if task == "forward" else -speed) - Crawler.EFFORT_COST * effort


def main(
    *,
    num_episodes: int = 40,
    episode_steps: int = 200,
    updates: int = 200,  # after each episode
    batch_size: int = 256,
    num_cells: tuple[int, ...] = (128, 128),
    seed: int = 0,
) -> list[float]:
    """Check the body and train one policy for all of its designs; returns what the first designs earn after that."""
    torch.manual_seed(seed)  # initial weights
    env = Crawler(episode_steps=episode_steps, seed=seed)
    check_env_specs(env)

    learner = SACLearner(
        make_policy(env, num_cells=num_cells), make_qvalue(env, num_cells=num_cells), lr=1e-3, seed=seed
    )
    buffer = TransitionBuffer(num_episodes * episode_steps, seed=seed)
    draw_design, rng = RandomDesigns(env.design_spec), torch.Generator().manual_seed(seed)
    for episode in range(num_episodes):
        design = draw_design(torch.ones(1, env.DESIGN_SIZE), rng=rng)
        rows = run_episode(env, learner.policy, design=design, rng=rng)
        buffer.extend(rows)
        learner.update(sample_batches(buffer, batch_size=batch_size, num_batches=updates, rng=rng))
        print(f"episode {episode}, {named(design[0])}: return {rows['next', 'reward'].sum().item():.2f}")

    # The first designs side by side, without noise in the actions.
    designs = torch.tensor(Crawler.FIRST_DESIGNS)
    fleet = Crawler(num_runs=len(designs), episode_steps=episode_steps, seed=seed + 1)
    rewards = run_episode(fleet, learner.policy, design=designs, deterministic=True)["next", "reward"]
    returns = rewards.sum(0).squeeze(-1).tolist()
    for design, achieved in zip(designs, returns):
        print(f"after training, {named(design)}: return {achieved:.2f}")
    return returns


def named(design: Tensor) -> str:
    """The entries of a design ``[D]`` with their names."""
    return ", ".join(f"{name} {xi:.2f}" for name, xi in zip(Crawler.DESIGN_NAMES, design.tolist()))


if __name__ == "__main__":
    main()
