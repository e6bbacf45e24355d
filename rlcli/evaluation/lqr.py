"""Linear-quadratic regulator (LQR) of a task at its default state, a reference for trained policies.

The linear model is identified from the environment: one step from each of many states near the default state, with
small actions. The regulator uses the policy's observations and actions. A task has no regulator if its default state is
not an equilibrium, if the observations do not determine the state, or if no linear feedback stabilises the default
state.
"""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rlcli.config.load import Resolved
from rlcli.envs.make import make_env
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import UsageError, listing

Matrix = NDArray[Any]
_SPREAD = 1e-2
"""Largest deviation of the sampled states and actions from the default ones [m, rad, m/s, rad/s, unit of actions]."""
_MAX_RESIDUAL = 1e-2
"""Largest residual of a linear fit, as a share of the root mean square of the fitted values."""
_MAX_DRIFT = 1e-5
"""Largest movement of an equilibrium in one step [m or rad, m/s or rad/s]."""
_SINGULAR = 1e-4
"""Fraction of the largest singular value of the observations below which a singular value is a rounding error."""
_MAX_ITERATIONS = 100_000
_MAX_COST = 1e12
"""Largest cost of a state of length 1; with a higher cost, the system counts as one that no feedback stabilises."""


@dataclass(frozen=True, slots=True)
class Regulator:
    """LQR as a policy: action = -gain (observation - rest), clamped to the bound."""

    gain: Matrix
    """Gain matrix K of the regulator. (actions, observations)"""
    rest: Matrix
    """Observation in the equilibrium, at which the regulator's action is 0. (observations,)"""
    bound: float | None
    """Largest absolute action; None: no bound."""
    poles: tuple[float, ...]
    """Absolute values of the closed loop's poles, per control step, the largest first; stable below 1."""

    def acting(self, env: VecEnv) -> Callable[[Tensor], Tensor]:
        """Return the policy as a function from observations (num_envs, d) to actions, on the device of `env`."""
        gain = torch.from_numpy(self.gain).to(env.device)
        rest = torch.from_numpy(self.rest).to(env.device)

        def act(obs: Tensor) -> Tensor:
            action = -(((obs.double() - rest)[:, None, :] * gain).sum(dim=2))
            return (action if self.bound is None else action.clamp(-self.bound, self.bound)).float()

        return act


def regulator(resolved: Resolved, bound: float | None) -> Regulator:
    """Compute the LQR of a task, for the cost |x|^2 + |u / bound|^2 per step.

    x: deviations of positions and velocities from the default state. u: actions. Without a bound, u is divided by 1.

    Args:
        resolved: the task.
        bound: largest absolute action; None: no bound.

    Raises:
        UsageError: if the task has no LQR, with the reason.
    """
    if not resolved.task.success:
        raise _no_regulator_error(resolved, "the task defines no condition of success, so its target state is unknown")
    with contextlib.closing(make_env(resolved.with_num_envs(1).without_randomness())) as env:
        model = env.engine.model
        if model.nq != model.nv:
            raise _no_regulator_error(
                resolved, "the model has a floating body or a ball joint; only hinges and slides are supported"
            )
        if model.na:
            raise _no_regulator_error(resolved, "the model's actuators have internal states")
        count = 2 * model.nv + env.layout.action_size
    with contextlib.closing(make_env(resolved.with_num_envs(2 + 16 * count).without_randomness())) as env:
        states, after, observed, rest = _sample_steps(env, resolved)
    dynamics, residual = _fit(states, after)
    if residual.max() > _MAX_RESIDUAL:
        why = "position, velocity and action do not determine the next state linearly"
        if _contacts(env):
            why += ": contacts open, close or slip near the default state"
        raise _no_regulator_error(resolved, why)
    nx = after.shape[1]
    decoder, residual = _fit(observed, after)
    if residual.max() > _MAX_RESIDUAL:
        unseen = listing(_coordinates(env)[i] for i in (residual > _MAX_RESIDUAL).nonzero()[0])
        raise _no_regulator_error(resolved, f"the task's observations do not determine the state: {unseen}")
    a, b = dynamics[:nx].T, dynamics[nx:].T  # x+ = a x + b u
    gain = riccati(a, b, np.eye(nx), np.eye(b.shape[1]) / (bound or 1.0) ** 2)
    poles = tuple(sorted(np.abs(np.linalg.eigvals(a - b @ gain)).tolist(), reverse=True)) if gain is not None else ()
    if gain is None or poles[0] >= 1.0:
        raise _no_regulator_error(resolved, "no linear feedback stabilises the default state")
    return Regulator(gain @ decoder.T, rest, bound, poles)


def riccati(a: Matrix, b: Matrix, q: Matrix, r: Matrix) -> Matrix | None:
    """Return the gain k of the feedback u = -k x that minimises the sum of x'qx + u'ru; None if there is no such gain.

    x is the state, u the input, and the next state is a x + b u.

    The discrete algebraic Riccati equation is iterated from q on; iteration n gives the cost of a horizon of n steps.
    """
    cost, gain = q, np.zeros((b.shape[1], a.shape[0]))
    for _ in range(_MAX_ITERATIONS):
        gain = np.linalg.solve(r + b.T @ cost @ b, b.T @ cost @ a)
        longer = q + a.T @ cost @ (a - b @ gain)
        longer = (longer + longer.T) / 2  # keeps rounding errors symmetric
        if np.abs(longer).max() > _MAX_COST:
            return None
        if np.abs(longer - cost).max() <= 1e-12 * np.abs(longer).max():
            return gain
        cost = longer
    return None


def _sample_steps(env: VecEnv, resolved: Resolved) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Make one step from many states near the default state, as data for the fit of a linear model.

    The samples come in pairs on opposite sides of the default state. Half the difference of a pair is returned, in
    which quadratic and other even terms cancel.

    Returns:
        Four matrices of deviations from the default state. Three have one row for each pair: state and action, next
        state, observation. The last is the observation at the default state.

    Raises:
        UsageError: if the default state is not an equilibrium in which the task succeeds.
    """
    env.reset(seed=0)
    engine, pairs, nv = env.engine, env.num_envs // 2 - 1, env.engine.model.nv
    all_envs = engine.select(torch.ones(env.num_envs, dtype=torch.bool, device=env.device), 0, env.episode_index)
    assert all_envs is not None
    engine.reset(all_envs)
    qpos, qvel = engine.field("qpos"), engine.field("qvel")
    middle = qpos[0].clone()
    drawn = np.random.default_rng(0).uniform(-_SPREAD, _SPREAD, (pairs, 2 * nv + env.layout.action_size))
    # environments 0 and 1 stay at the default state, the others come in pairs
    both = torch.from_numpy(np.concatenate([np.zeros((2, drawn.shape[1])), drawn, -drawn])).to(env.device)
    qpos.copy_(middle + both[:, :nv])
    qvel.copy_(both[:, nv : 2 * nv])
    env.on_moved(all_envs)
    env.sim.forward_moved()
    step = env.step(both[:, 2 * nv :].float())
    if bool((step.terminated | step.truncated).any()):
        raise _no_regulator_error(resolved, "the default state ends an episode")
    after = torch.cat([qpos - middle, qvel], dim=1).double().cpu().numpy()
    observed = step.obs["policy"].double().cpu().numpy()
    if np.abs(after[0]).max() > _MAX_DRIFT:
        moved = _coordinates(env)[int(np.abs(after[0]).argmax())]
        contacts = _contacts(env)
        why = f"the default state is not an equilibrium: {moved} moves"
        if contacts:
            why += f" (contacts there: {contacts})"
        rest = "set scene.entities.NAME.init.joint_pos to a pose at rest, as `rlcli play TASK --policy zero` shows it"
        if contacts:
            rest += "; there a body lies slightly inside the body that carries it"
        raise _no_regulator_error(resolved, why, f"{rest}; or use --policy trained, zero or random")
    success = env.compute_success()
    if success is None or not bool(success[0]):
        raise _no_regulator_error(resolved, "the regulator does not succeed at the default state")
    half = [(values[2 : 2 + pairs] - values[2 + pairs :]) / 2 for values in (after, observed)]
    return drawn, half[0], half[1], observed[0]


def _fit(inputs: Matrix, targets: Matrix) -> tuple[Matrix, Matrix]:
    """Fit `targets = inputs @ matrix` by least squares; return (matrix, relative error of each column of targets)."""
    found, *_ = np.linalg.lstsq(inputs, targets, rcond=_SINGULAR)
    residual = np.sqrt(np.square(targets - inputs @ found).mean(axis=0))
    return found, residual / np.maximum(np.sqrt(np.square(targets).mean(axis=0)), 1e-9)


def _coordinates(env: VecEnv) -> list[str]:
    """Return a name for each element of the state: joints, then `the velocity of` each joint."""
    model = env.engine.model
    names = [model.joint(int(model.dof_jntid[dof])).name.rpartition("/")[2] for dof in range(model.nv)]
    return [*names, *(f"the velocity of {name}" for name in names)]


def _contacts(env: VecEnv) -> int:
    """Return the number of contacts in environment 0."""
    data = mujoco.MjData(env.engine.model)
    data.qpos[:] = env.engine.field("qpos")[0].cpu().numpy()
    mujoco.mj_forward(env.engine.model, data)
    return int(data.ncon)


def _no_regulator_error(resolved: Resolved, why: str, hint: str = "use --policy trained, zero or random") -> UsageError:
    name = resolved.source.name
    return UsageError(f"an LQR (linear-quadratic regulator) of {name} cannot be computed, because {why}", hint=hint)
