"""Our loss and our bodies in a pipeline of TorchRL: its collector, replay buffer, optimiser, target update and trainer.

Nothing of Algorithm 1 is used: soft actor-critic on the design-conditioned state (Eq. 3-4) trains one policy for all
bodies, and a transform draws another body for each episode.

References:
    "Co-Imagination of Behaviour & Morphology of Agents" (CoIm), Eq. 3-4.
    Bou et al. 2023, TorchRL: A data-driven decision-making library for PyTorch (arXiv:2306.00577).
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import TensorDictPrimer, TransformedEnv
from torchrl.objectives import SoftUpdate
from torchrl.trainers import DefaultOptimizationStepper, ReplayBufferTrainer, TargetNetUpdaterHook, Trainer

from coim import CoImSACLoss, HopperMorph, make_policy, make_qvalue


def main(
    *,
    num_episodes: int = 20,
    episode_steps: int = 1000,
    updates: int = 250,  # after each episode
    batch_size: int = 256,
    num_cells: tuple[int, ...] = (200, 200, 200),
    seed: int = 0,
) -> list[float]:
    """Train one policy for many hoppers; returns the return of each episode."""
    torch.manual_seed(seed)
    hopper = HopperMorph(episode_steps=episode_steps, seed=seed)
    draw_body = TensorDictPrimer(hopper.state_spec, random=True, call_before_env_reset=True)
    env = TransformedEnv(hopper, draw_body)
    policy, qvalue = make_policy(env, num_cells=num_cells), make_qvalue(env, num_critics=2, num_cells=num_cells)
    frames = num_episodes * episode_steps
    collector = Collector(
        env,
        policy,
        frames_per_batch=episode_steps,
        total_frames=frames,
        auto_register_policy_transforms=False,  # this policy keeps nothing from step to step
    )

    loss = CoImSACLoss(policy, qvalue, alpha=0.01, gamma=0.99)
    trainer = Trainer(
        collector=collector,
        total_frames=frames,
        frame_skip=1,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=3e-4),
        optimization_stepper=DefaultOptimizationStepper(),  # one step down loss_actor + loss_qvalue
        optim_steps_per_batch=updates,
        progress_bar=False,
    )
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(frames), batch_size=batch_size)
    replay = ReplayBufferTrainer(buffer, flatten_tensordicts=True)
    # Hooks one by one: `register` would move the targets once for each episode instead of after each update, and
    # would use a stage for priorities that TorchRL is about to remove.
    trainer.register_op("batch_process", replay.extend)
    trainer.register_op("process_optim_batch", replay.sample)
    trainer.register_op("post_optim", TargetNetUpdaterHook(SoftUpdate(loss, tau=0.005)))

    returns: list[float] = []

    def report(batch: TensorDictBase) -> None:
        """Print a line for the episode that was collected."""
        returns.append(batch["next", "reward"].sum().item())
        body = [round(xi, 2) for xi in batch["design"].reshape(-1, hopper.DESIGN_SIZE)[0].tolist()]
        print(f"episode {len(returns) - 1}, design {body}: return {returns[-1]:.2f}")

    trainer.register_op("pre_steps_log", report)
    trainer.train()
    return returns


if __name__ == "__main__":
    main()
