"""Base class of Gymnasium's MuJoCo tasks. It computes in the engine's dtype; only its outputs become float32.

Two things are as in Gymnasium and differ from the rest of rlcli. Derived fields (xpos, cinert, forces) lag by one
physics step, as `mj_step` leaves them; the setting `sim.derived_fields: substep` of the tasks does this. The cost of an
action is summed in float32, in the order in which numpy adds.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import ClassVar

import mujoco
import torch
from torch import Tensor

from rlcli.envs.direct import DirectTask
from rlcli.sim.env_selection import Selection


class GymnasiumTask(DirectTask):
    """Base class of Gymnasium's MuJoCo tasks, as a direct task of rlcli.

    `observation` (num_envs, k) and `reward` (num_envs,) are the values of the buffers before the cast to float32.
    `ended` (num_envs,) is true where the task terminates the episode; it is computed before the reward, which may
    depend on it.
    """

    motors = False
    reads: ClassVar[tuple[str, ...]] = ()
    """Derived fields of the engine that the task reads."""
    moves: ClassVar[bool] = False
    """Whether the reward uses `speed`; the base class then stores `progress` before each step."""

    def set_up_scene(self, scene) -> None:
        """Replace the PGS solver by Newton's method if the task runs on MuJoCo Warp, which has no PGS."""
        on_warp = self.cfg.sim.engine == "warp" or (self.cfg.sim.engine == "auto" and self.device.type == "cuda")
        if on_warp and scene.spec.option.solver == mujoco.mjtSolver.mjSOL_PGS:
            scene.spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON

    def post_reset(self) -> None:
        """Look up the engine's fields, such as `qpos`, and create the buffers that the hooks fill."""
        engine = self.env.engine
        self.model = engine.model
        self.field = SimpleNamespace(**{name: engine.field(name) for name in ("qpos", "qvel", "ctrl", *self.reads)})
        self.dtype = self.field.qpos.dtype
        self.start_pos = torch.tensor(self.model.qpos0, dtype=self.dtype, device=self.device)
        self.action_names = tuple(self.model.actuator(a).name.removeprefix("robot/") for a in range(self.model.nu))
        self.action_limits = tuple((float(low), float(high)) for low, high in self.model.actuator_ctrlrange)
        self.actions = torch.zeros(self.num_envs, self.num_actions, device=self.device)
        self.observation = torch.zeros(self.num_envs, self.num_observations, dtype=self.dtype, device=self.device)
        self.reward = torch.zeros(self.num_envs, dtype=self.dtype, device=self.device)
        self.ended = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self.before = self.progress().clone()

    def pre_physics_step(self, actions: Tensor) -> None:
        """Write the actions to the controls."""
        self.actions.copy_(actions)
        self.field.ctrl.copy_(actions)
        if self.moves:
            self.before.copy_(self.progress())

    def get_observations(self) -> None:
        """Fill obs_buf with the columns of `columns`, as float32."""
        torch.cat(self.columns(), dim=1, out=self.observation)
        self.obs_buf.copy_(self.observation)

    def calculate_metrics(self) -> None:
        """Fill `ended`, then rew_buf with the result of `compute_reward`, as float32."""
        self.check_termination()
        self.reward.copy_(self.compute_reward())
        self.rew_buf.copy_(self.reward)

    def is_done(self) -> None:
        """Fill reset_buf, which marks terminated episodes, with `ended`."""
        self.reset_buf.copy_(self.ended)

    def reset(self, selection: Selection) -> None:
        """Write the initial state of `start` to the environments that reset."""
        qpos, qvel = self.start(selection)
        selection.write(self.field.qpos, qpos)
        selection.write(self.field.qvel, qvel)

    # --- implemented by each task ---

    def columns(self) -> list[Tensor]:
        """Return tensors whose columns, one after the other, are the observation. (num_envs, k) each"""
        raise NotImplementedError

    def compute_reward(self) -> Tensor:
        """Return the reward of the step, in the engine's dtype. (num_envs,)"""
        raise NotImplementedError

    def check_termination(self) -> None:
        """Set `ended` to true where the task terminates the episode. The base class never terminates an episode."""

    def start(self, selection: Selection) -> tuple[Tensor, Tensor]:
        """Return initial positions and velocities, one row per environment that resets. (rows, nq), (rows, nv)"""
        raise NotImplementedError

    def progress(self) -> Tensor:
        """Return the position whose change is rewarded. (num_envs,) [m]"""
        return self.field.qpos[:, 0]

    # --- shared by several tasks ---

    def speed(self) -> Tensor:
        """Return the change of `progress` over the step, for a task with `moves = True`. (num_envs,) [m/s]"""
        assert self.moves
        return (self.progress() - self.before) / self.step_dt

    def action_cost(self, weight: float) -> Tensor:
        """Return the weighted sum of squared actions, computed in float32. (num_envs,)"""
        return weight * float32_sum(self.actions.square())

    def uniform_start(self, selection: Selection, scale: float) -> tuple[Tensor, Tensor]:
        """Sample positions in qpos0 +- scale and velocities in +-scale, uniformly. (rows, nq), (rows, nv)"""
        positions = self.model.nq
        noise = self.noise(selection, scale, positions + self.model.nv)
        return self.start_pos + noise[:, :positions], noise[:, positions:]

    def gaussian_start(self, selection: Selection, scale: float) -> tuple[Tensor, Tensor]:
        """Sample positions in qpos0 +- scale, and normal velocities with std `scale`. (rows, nq), (rows, nv)"""
        qpos = self.start_pos + self.noise(selection, scale, self.model.nq)
        return qpos, selection.normal(0.0, scale, (self.model.nv,))

    def noise(self, selection: Selection, scale: float, size: int) -> Tensor:
        """Sample uniformly in +-scale, one row per environment that resets. (rows, size)"""
        return selection.uniform(-scale, scale, (size,))


def float32_sum(values: Tensor) -> Tensor:
    """Sum up to eight columns in numpy's order, for bit-identical results. (num_envs,)"""
    columns = list(values.unbind(dim=1))
    if len(columns) == 8:
        while len(columns) > 1:
            columns = [a + b for a, b in zip(columns[::2], columns[1::2], strict=True)]
    total = columns[0]
    for column in columns[1:]:
        total = total + column
    return total


def square_sum(values: Tensor) -> Tensor:
    """Return the sum of all squared values in each environment. (num_envs, ...) -> (num_envs,)"""
    return values.square().flatten(1).sum(dim=1)


def within(values: Tensor, low: float, high: float) -> Tensor:
    """Return whether each value is above `low` and below `high`. bool, in the shape of `values`"""
    return (values > low) & (values < high)


__all__ = ["GymnasiumTask", "float32_sum", "square_sum", "within"]
