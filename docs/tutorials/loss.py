"""
The loss in your own loop
=========================

`CoImSACLoss` is an ordinary ``LossModule`` of TorchRL. It is soft actor-critic on the state and the design. Nothing
else of ``coim`` is needed for it: networks, buffer, optimiser and loop may be yours.
"""

# %%
# Networks, loss, optimiser
# -------------------------
#
# `make_policy` and `make_qvalue` read the sizes of an environment. They scale their inputs by constants of the body.

import matplotlib.pyplot as plt
import torch
from torchrl.objectives import SoftUpdate

from coim import CoImSACLoss, HopperMorph, make_policy, make_qvalue

torch.manual_seed(0)
env = HopperMorph(num_runs=4, episode_steps=100, seed=0)
policy = make_policy(env, num_cells=(64, 64))
qvalue = make_qvalue(env, num_critics=2, num_cells=(64, 64))
loss = CoImSACLoss(policy, qvalue, alpha=0.01, gamma=0.99)
targets = SoftUpdate(loss, tau=0.005)
optimiser = torch.optim.Adam(loss.parameters(), lr=3e-4)

# %%
# Rows of four random bodies
# --------------------------
#
# A batch is what TorchRL's collectors return, with the design in each row.

start = env.reset(env.full_state_spec.rand())
with torch.no_grad():
    rows = env.rollout(100, policy, auto_reset=False, tensordict=start).reshape(-1)
print(rows.batch_size, {name: round(value.item(), 3) for name, value in loss(rows[:64]).items()})

# %%
# The loop
# --------

curve = []
for _ in range(100):
    batch = rows[torch.randint(len(rows), (64,))]
    losses = loss(batch)
    optimiser.zero_grad()
    (losses["loss_actor"] + losses["loss_qvalue"]).backward()
    optimiser.step()
    targets.step()
    curve.append(losses["loss_qvalue"].item())

figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
axes.plot(curve)
axes.set(xlabel="update", ylabel="loss of the critics", yscale="log")

# %%
# Imagined rows
# -------------
#
# Rows that a model imagined are marked by an entry ``imagined``. With ``mix="batch"``, the default, real and imagined
# rows share one mean, as Sec. 5 of the paper describes. With ``mix="sum"``, each kind has a mean of its own and the
# two are added, as Eq. 7 and 8 are printed.

batch = rows[:64].set("imagined", torch.zeros(64, 1, dtype=torch.bool))
batch["imagined"][:13] = True
as_printed = CoImSACLoss(policy, qvalue, alpha=0.01, gamma=0.99, mix="sum")
SoftUpdate(as_printed, tau=0.005)  # would be stepped after each update, as above
print(as_printed(batch)["loss_qvalue"].item())

# %%
# What else fits
# --------------
#
# - The loss reads the entries of TorchRL's n-step and prioritised replay (``steps_to_next_obs`` and
#   ``priority_weight``), and writes ``td_error``.
# - `SACLearner` is the same loss with Adam and the target update, with its gradients written out for speed.
# - ``recipes/own_pipeline.py`` puts the loss into TorchRL's ``Collector`` and ``Trainer``.
