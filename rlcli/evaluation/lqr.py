"""A known answer beside a learned one: the linear-quadratic regulator of a task about its default state.

The task itself is asked how it moves: one step from many states near the default one, with small actions, gives its
linear model, in the policy's own observations and actions. Where the default state is no equilibrium, where the
observations do not say in which state the task is, or where no linear law holds it, there is no regulator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

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
"""Of the states and actions that are tried, about the default ones."""
_MISFIT = 1e-2
"""How much of what is observed may be left unexplained, as a share of its size."""
_STILL = 1e-5
"""How far an equilibrium may move in a step [m or rad, m/s or rad/s]."""
_SINGULAR = 1e-4
"""Directions of the observations that are this much weaker than the strongest are rounding."""
_ROUNDS = 100_000
_MOST_COST = 1e12
"""Of a state of 1, beyond which nothing holds it."""


@dataclass(frozen=True, slots=True)
class Regulator:
    """action = -gain (observation - rest), within the bound."""

    gain: Matrix
    """(actions, observations)"""
    rest: Matrix
    """The observation of the equilibrium. (observations,)"""
    bound: float | None
    poles: tuple[float, ...]
    """Absolute values of the closed loop's, per control step; below 1 it is stable."""

    def acting(self, env: VecEnv) -> Callable[[Tensor], Tensor]:
        """The regulator in an environment."""
        gain = torch.from_numpy(self.gain).to(env.device)
        rest = torch.from_numpy(self.rest).to(env.device)

        def act(obs: Tensor) -> Tensor:
            action = -(((obs.double() - rest)[:, None, :] * gain).sum(dim=2))
            return (action if self.bound is None else action.clamp(-self.bound, self.bound)).float()

        return act


def regulator(resolved: Resolved, bound: float | None) -> Regulator:
    """The regulator of a task: unit weights on positions, velocities, and actions as shares of the bound.

    Args:
        resolved: the task.
        bound: of its actions; None: they have none.

    Raises:
        UsageError: if the task has none, with the reason.
    """
    if resolved.task.success is None:
        raise _refused(resolved, "the task defines no success, so that nothing says where it is to be held")
    env = make_env(_still(resolved, 1))
    try:
        model = env.engine.model
        if model.nq != model.nv:
            raise _refused(resolved, "something in it floats or turns freely, and this regulator has hinges and slides")
        if model.na:
            raise _refused(resolved, "its actuators have states of their own")
        count = 2 * model.nv + env.layout.action_size
    finally:
        env.close()
    env = make_env(_still(resolved, 2 + 16 * count))
    try:
        states, after, observed, rest = _try(env, resolved)
    finally:
        env.close()
    model_of, misfit = _fit(states, after)
    if misfit.max() > _MISFIT:
        raise _refused(resolved, "position, velocity and action do not say how it moves on")
    nx = after.shape[1]
    decoder, misfit = _fit(observed, after)
    if misfit.max() > _MISFIT:
        unseen = listing(_coordinates(env)[i] for i in (misfit > _MISFIT).nonzero()[0])
        raise _refused(resolved, f"its observations do not determine the state: {unseen}")
    a, b = model_of[:nx].T, model_of[nx:].T
    gain = riccati(a, b, np.eye(nx), np.eye(b.shape[1]) / (bound or 1.0) ** 2)
    poles = tuple(sorted(np.abs(np.linalg.eigvals(a - b @ gain)).tolist(), reverse=True)) if gain is not None else ()
    if gain is None or poles[0] >= 1.0:
        raise _refused(resolved, "no linear law holds it at its default state")
    return Regulator(gain @ decoder.T, rest, bound, poles)


def riccati(a: Matrix, b: Matrix, q: Matrix, r: Matrix) -> Matrix | None:
    """The gain k of u = -k x that minimises the sum of x'qx + u'ru along x+ = a x + b u; None if there is none.

    The discrete algebraic Riccati equation, iterated from q on: the cost of ever longer horizons.
    """
    cost, gain = q, np.zeros((b.shape[1], a.shape[0]))
    for _ in range(_ROUNDS):
        gain = np.linalg.solve(r + b.T @ cost @ b, b.T @ cost @ a)
        longer = q + a.T @ cost @ (a - b @ gain)
        longer = (longer + longer.T) / 2
        if np.abs(longer).max() > _MOST_COST:
            return None
        if np.abs(longer - cost).max() <= 1e-12 * np.abs(longer).max():
            return gain
        cost = longer
    return None


def _try(env: VecEnv, resolved: Resolved) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """States and actions, the states a step later, what is then observed, and what is observed at rest.

    The first three are half the differences of pairs about the default state: what is even in them drops out.
    """
    env.reset(seed=0)
    engine, pairs, nv = env.engine, env.num_envs // 2 - 1, env.engine.model.nv
    everyone = engine.select(torch.ones(env.num_envs, dtype=torch.bool, device=env.device), 0, env.episode_index)
    assert everyone is not None
    engine.reset(everyone)
    qpos, qvel = engine.field("qpos"), engine.field("qvel")
    middle = qpos[0].clone()
    drawn = np.random.default_rng(0).uniform(-_SPREAD, _SPREAD, (pairs, 2 * nv + env.layout.action_size))
    both = torch.from_numpy(np.concatenate([np.zeros((2, drawn.shape[1])), drawn, -drawn])).to(env.device)
    qpos.copy_(middle + both[:, :nv])
    qvel.copy_(both[:, nv : 2 * nv])
    env.sim.on_moved(everyone)
    for sensor in env.sensors.values():
        sensor.on_moved(everyone)
    env.sim.forward_moved()
    step = env.step(both[:, 2 * nv :].float())
    if bool((step.terminated | step.truncated).any()):
        raise _refused(resolved, "its default state ends an episode")
    after = torch.cat([qpos - middle, qvel], dim=1).double().cpu().numpy()
    observed = step.obs["policy"].double().cpu().numpy()
    if np.abs(after[0]).max() > _STILL:
        moved = _coordinates(env)[int(np.abs(after[0]).argmax())]
        raise _refused(resolved, f"its default state is no equilibrium: {moved} moves")
    succeeding = env.compute_success()
    if succeeding is None or not bool(succeeding[0]):
        raise _refused(resolved, "its default state is not where it succeeds")
    half = [(values[2 : 2 + pairs] - values[2 + pairs :]) / 2 for values in (after, observed)]
    return drawn, half[0], half[1], observed[0]


def _fit(given: Matrix, wanted: Matrix) -> tuple[Matrix, Matrix]:
    """The matrix that maps rows of the one to rows of the other, and how much of each column it leaves unexplained."""
    found, *_ = np.linalg.lstsq(given, wanted, rcond=_SINGULAR)
    left = np.sqrt(np.square(wanted - given @ found).mean(axis=0))
    return found, left / np.maximum(np.sqrt(np.square(wanted).mean(axis=0)), 1e-9)


def _still(resolved: Resolved, count: int) -> Resolved:
    """The task without chance: no events, no noise, so many environments."""
    task = resolved.task
    observations = {
        name: group.model_copy(update={"enable_corruption": False}) for name, group in task.observations.items()
    }
    scene = task.scene.model_copy(update={"num_envs": count})
    still: dict[str, Any] = {"scene": scene, "events": {}, "curriculum": {}, "observations": observations}
    return replace(resolved, task=task.model_copy(update=still))


def _coordinates(env: VecEnv) -> list[str]:
    model = env.engine.model
    names = [model.joint(int(model.dof_jntid[dof])).name.rpartition("/")[2] for dof in range(model.nv)]
    return [*names, *(f"the velocity of {name}" for name in names)]


def _refused(resolved: Resolved, why: str) -> UsageError:
    return UsageError(f"there is no LQR of {resolved.source.name}: {why}", hint="other policies: trained, zero, random")
