"""Measure the energy error of a physics time step, by comparison with a simulation with half the time step.

The rule `timestep` of `rlcli lint` reports time steps that are too long.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np

from rlcli.envs.vec_env import VecEnv

PASSIVE_S = 1.0
"""Simulated time without actuators [s]."""
MAX_STEPS = 1000
"""Largest number of physics steps of a simulation."""


@dataclass(frozen=True, slots=True)
class Drift:
    """Energy error of a time step: the difference from a simulation with half the step, without actuators."""

    relative: float
    """Largest difference between the energy with dt and with dt / 2, relative to the energy that is exchanged between
    potential and kinetic; median over the start states. Infinite if only the simulation with dt diverges."""
    seconds: float
    """Simulated time [s]."""


def energy_drift(env: VecEnv, starts: int = 8) -> Drift:
    """Measure the energy error of the time step, without actuators, from the current states of some environments.

    Args:
        env: the environments.
        starts: largest number of start states; the result is the median over the start states.
    """
    model, _ = env.world(0)
    dt = float(model.opt.timestep)
    steps = max(1, min(MAX_STEPS, round(PASSIVE_S / dt)))
    worst = []
    for number in range(min(starts, env.num_envs)):
        model, data = env.world(number)
        coarse, fine = (_energy(model, data, dt / parts, steps, parts) for parts in (1, 2))
        worst.append(_difference(coarse, fine))
    return Drift(float(np.median(worst)), steps * dt)


def _energy(model: mujoco.MjModel, start: mujoco.MjData, dt: float, steps: int, parts: int) -> np.ndarray:
    """Simulate without actuators; return potential and kinetic energy over time. (steps + 1, 2) [J]

    The energies are NaN after a divergence.

    Args:
        model: the model.
        start: the start state.
        dt: physics time step [s].
        steps: number of energies after the first one.
        parts: number of physics steps between two energies.
    """
    model = copy.copy(model)
    model.opt.timestep = dt
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    data = mujoco.MjData(model)
    for name in ("qpos", "qvel", "mocap_pos", "mocap_quat", "eq_active"):
        getattr(data, name)[:] = getattr(start, name)
    energy = np.full((steps + 1, 2), np.nan)
    mujoco.mj_forward(model, data)
    energy[0] = data.energy
    for step in range(steps):
        for _ in range(parts):
            mujoco.mj_step(model, data)
        if any(data.warning[kind].number for kind in _DIVERGED):
            break
        mujoco.mj_forward(model, data)
        energy[step + 1] = data.energy
    return energy


_W = mujoco.mjtWarning
_DIVERGED = [int(w) for w in (_W.mjWARN_BADQPOS, _W.mjWARN_BADQVEL, _W.mjWARN_BADQACC)]


def _difference(coarse: np.ndarray, fine: np.ndarray) -> float:
    """Return the largest difference of the total energies of two simulations, relative to the exchanged energy.

    Args:
        coarse: potential and kinetic energy with the time step. (steps + 1, 2)
        fine: the same with half the time step.
    """
    if np.isnan(coarse).any():
        return np.inf
    if np.isnan(fine).any():
        return 0.0  # if half the step diverges too, the step's length is not the cause
    potential, kinetic = np.concatenate([coarse, fine]).T
    scale = max(float(np.ptp(fine[:, 0])), float(fine[:, 1].max()))
    largest = max(scale, 1e-9 * max(float(np.abs(potential).max()), float(kinetic.max())), 1e-12)
    return float(np.abs(coarse.sum(axis=1) - fine.sum(axis=1)).max()) / largest
