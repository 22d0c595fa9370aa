"""What the tests of the three bodies share: Gymnasium's bodies to compare with, and facts of physics as numbers."""

from __future__ import annotations

import itertools
import warnings
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from coim.envs import MorphEnv

GYMNASIUM_ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"


def reset_to(env: MorphEnv, design: Tensor) -> TensorDict:
    """Reset all rows with the designs ``[K, D]``, or one design ``[D]`` for all."""
    return env.reset(TensorDict({"design": design.expand(*env.batch_size, -1)}, env.batch_size))


def gymnasium_spec(file: str) -> mujoco.MjSpec:
    """Gymnasium's own body of this file."""
    return mujoco.MjSpec.from_file(str(GYMNASIUM_ASSETS / file))


def compile_quietly(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile without a word, to the console or to MuJoCo's log file: Gymnasium's cheetah uses a deprecated setting."""
    before, quiet = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
    quiet.logto_file = quiet.logto_console = False
    quiet.set()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = spec.compile()
    before.set()
    return model


def difference_from(model: mujoco.MjModel, env: MorphEnv, num_steps: int) -> float:
    """Largest difference of positions and velocities between row 0 and a MuJoCo loop over ``model``, same controls."""
    data = mujoco.MjData(model)
    generator = torch.Generator().manual_seed(0)
    worst = 0.0
    for _ in range(num_steps):
        action = 2 * torch.rand(*env.action_spec.shape, generator=generator) - 1
        env.advance(action)
        data.ctrl[:] = action[0].numpy()
        mujoco.mj_step(model, data, env.FRAME_SKIP)
        positions = np.abs(env.simulations.qpos[0] - data.qpos).max()
        worst = max(worst, positions, np.abs(env.simulations.qvel[0] - data.qvel).max())
    return worst


def mass_error(env: MorphEnv) -> float:
    """Largest relative error of a body's mass against density times the volume of its capsules."""
    model = env.simulations.model(0)
    density = {"half_cheetah.xml": 660.8849500774736, "ant.xml": 5.0}.get(env.ASSET, 1000.0)
    masses = np.zeros(model.nbody)
    for i in range(1, model.ngeom):  # 0 is the floor
        radius, half_length = model.geom_size[i, :2]
        masses[model.geom_bodyid[i]] += density * np.pi * radius**2 * (2 * half_length + 4 / 3 * radius)
    return float(np.abs(model.body_mass[1:] / masses[1:] - 1).max())


def total_mass(env: MorphEnv) -> float:
    """Mass of row 0 in kg."""
    return float(env.simulations.model(0).body_mass.sum())


def corners_and_random(body: type[MorphEnv], num_random: int) -> Tensor:
    """All corners of the design space and some uniform designs, ``[P, D]``."""
    low, high = (bound.float() for bound in body.design_bounds())
    corners = torch.tensor(list(itertools.product(*zip(low.tolist(), high.tolist()))))
    generator = torch.Generator().manual_seed(0)
    return torch.cat([corners, low + (high - low) * torch.rand(num_random, body.DESIGN_SIZE, generator=generator)])


def num_contacts(env: MorphEnv) -> int:
    """Contacts of all rows as they stand, margins included."""
    contacts = 0
    for row in range(env.numel()):
        model = env.simulations.model(row)
        data = mujoco.MjData(model)
        data.qpos[:] = env.simulations.qpos[row]
        mujoco.mj_forward(model, data)
        contacts += data.ncon
    return contacts


def energy_drift(env: MorphEnv, num_steps: int) -> float:
    """Relative change of the energy of row 0 in free flight: no floor, no dampers, springs or joint stops."""
    model = env.simulations.model(0).__copy__()
    model.dof_damping[:] = 0
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model.opt.timestep = 1e-4
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data = mujoco.MjData(model)
    data.qvel[:] = np.random.default_rng(0).normal(size=model.nv)
    mujoco.mj_forward(model, data)
    before = data.energy.copy()
    for _ in range(num_steps):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    return float(abs(data.energy.sum() - before.sum()) / np.abs(before).max())
