"""
On a GPU, on a cluster
======================

A run of the paper's length takes a day on one core. There are two ways to get many of them: train many seeds
together in one process, which suits a GPU, or compute many processes at once, which suits a cluster.
"""

# %%
# What this machine has
# ---------------------
#
# ``coim check`` shows processor, GPU, compiler, OpenGL and versions, and says what will be slow or missing.

import torch

device = "cuda" if torch.cuda.is_available() else "cpu"
print(device)

# %%
# Many seeds in one process
# -------------------------
#
# ``num_runs=K`` makes K independent runs that learn in lock-step. K networks are one batched module with a leading
# axis, so that one product serves them all. The run axis is the last batch dimension of the data. Losses average over
# the batch and sum over the runs, so a run learns what it would learn alone.

from coim import HopperMorph, SACLearner, TransitionBuffer, make_policy, make_qvalue, run_episode, sample_batches

K = 4
env = HopperMorph(num_runs=K, episode_steps=100, seed=0, device=device)
policy = make_policy(env, num_cells=(32, 32), num_runs=K).to(device)
qvalue = make_qvalue(env, num_cells=(32, 32), num_runs=K).to(device)
learner = SACLearner(policy, qvalue, num_runs=K, seed=0)

rows = run_episode(env, learner.policy, design=env.design_spec.rand([K]))
buffer = TransitionBuffer(1000, num_runs=K, seed=0, device=device)
buffer.extend(rows)
losses = learner.update(sample_batches(buffer, batch_size=64, num_batches=20))
print(rows.batch_size, losses["loss_qvalue"].shape)

# %%
# On the command line the same is ``--num-runs``, and a GPU is ``--device``::
#
#     coim run walker --num-runs 10 --device cuda
#
# The simulations of a run are computed on the CPU. An environment of your own may have them on the GPU, by
# ``HopperMorph(num_runs=256, physics="warp", device="cuda")``: in float32, and not bit for bit the same the next time
# (see :doc:`/hardware`). On a GPU fifty updates are captured once as a CUDA graph and then replayed,
# because small networks would otherwise wait for Python. If the replay does not fit into the GPU's memory, add
# ``--replay-device cpu``.
#
# ``load_run(folder, run=k)`` takes one of the K runs out of a folder.

# %%
# Many processes
# --------------
#
# `Ray <https://docs.ray.io>`_ computes the cells of a study: on the cores of this machine, or on a cluster. All nodes
# must see the study's folder under the same path, and have the same version of ``coim``::
#
#     coim study paper --workers 8
#     coim study paper --ray-address 10.0.0.1:6379 --cpus 2
#     coim study paper --ray-address auto --cpus 2 --gpus 0.25
#
# ``--gpus 0.25`` lets four cells share a GPU, best through NVIDIA's MPS (``nvidia-cuda-mps-control -d``, once).
# ``seeds_per_cell`` in the study's file puts several seeds into one cell,
# where they are trained together. Forty runs are then four cells:

from coim.experiments.study.definition import Study

study = Study(name="many", environments=("walker",), arms=("none", "known"), seeds=tuple(range(20)), seeds_per_cell=10)
for cell in study.cells():
    print(cell.name, cell.settings.num_runs)

# %%
# ``coim retrain FOLDER --together 10 --gpus 1`` trains the designs of an arm likewise, ten of them in one process, each
# run with a body of its own.
#
# A cell whose process or node dies is taken up from its last checkpoint. ``ledger.csv`` in the study's folder says
# how far each cell is, and the same command goes on with what is left. Under a batch system such as Slurm, a run that
# is stopped by ``SIGTERM`` goes on by ``coim resume FOLDER``, with the same numbers as if it had not been stopped.
#
# :doc:`/hardware` has measured times.
