"""Gymnasium's ant, half cheetah, hopper, walker and swimmer: move along x."""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor

from rlcli.config.schema import StrictModel
from rlcli.sim.env_selection import Selection

from .base import GymnasiumTask, square_sum, within


class Ant(GymnasiumTask):
    """Ant-v5: a four-legged walker that observes contact forces."""

    moves = True
    num_observations = 105
    num_actions = 8
    observation_names = (
        *(f"qpos_{i}" for i in range(2, 15)),
        *(f"qvel_{i}" for i in range(14)),
        *(f"cfrc_ext_{body}_{i}" for body in range(1, 14) for i in range(6)),
    )
    reads = ("xpos", "cfrc_ext")

    class Params(StrictModel):
        """Parameters of the task, with Gymnasium's names."""

        forward_reward_weight: float = Field(1.0, description="Reward on the speed along x [s/m].")
        ctrl_cost_weight: float = Field(0.5, ge=0, description="Penalty on the sum of squared actions.")
        contact_cost_weight: float = Field(5e-4, ge=0, description="Penalty on the sum of squared contact forces.")
        healthy_reward: float = Field(1.0, description="Reward of a step that does not end the episode.")
        healthy_z_range: tuple[float, float] = Field(
            (0.2, 1.0), description="Range of the torso's height; outside it the episode terminates [m]."
        )
        contact_force_range: tuple[float, float] = Field((-1.0, 1.0), description="Clip of contact forces [N, N m].")
        reset_noise_scale: float = Field(
            0.1, ge=0, description="Half-width of position noise; standard deviation of velocity noise."
        )

    params: Params

    def post_reset(self) -> None:
        """Store the index of the torso's body, whose x is the progress."""
        self.torso = 1
        super().post_reset()

    def progress(self) -> Tensor:
        """Return x of the torso; as in Gymnasium, it lags by one physics step. (num_envs,) [m]"""
        return self.field.xpos[:, self.torso, 0]

    def contact_forces(self) -> Tensor:
        """Return torque and force of contacts on each body, clipped. (num_envs, bodies, 6) [N m, N]"""
        return self.field.cfrc_ext.clamp(*self.params.contact_force_range)

    def columns(self) -> list[Tensor]:
        """Return the observation: pose without x and y, velocity, and contact forces. (num_envs, k) each"""
        return [self.field.qpos[:, 2:], self.field.qvel, self.contact_forces()[:, 1:].flatten(1)]

    def healthy(self) -> Tensor:
        """Return whether the torso's height is in range. (num_envs,) bool"""
        low, high = self.params.healthy_z_range
        height = self.field.qpos[:, 2]
        return (height >= low) & (height <= high)

    def compute_reward(self) -> Tensor:
        """Return the reward: speed and a bonus for health, minus the costs of actions and contacts. (num_envs,)"""
        params = self.params
        gains = self.speed() * params.forward_reward_weight + ~self.ended * params.healthy_reward
        contact_cost = params.contact_cost_weight * square_sum(self.contact_forces())
        return gains - (self.action_cost(params.ctrl_cost_weight) + contact_cost)

    def check_termination(self) -> None:
        """Terminate where the robot is not healthy."""
        torch.logical_not(self.healthy(), out=self.ended)

    def start(self, selection: Selection) -> tuple[Tensor, Tensor]:
        """Sample positions uniformly, velocities from a Gaussian, around the default state. (rows, nq), (rows, nv)"""
        return self.gaussian_start(selection, self.params.reset_noise_scale)


class HalfCheetah(GymnasiumTask):
    """HalfCheetah-v5: a planar runner without termination."""

    moves = True
    num_observations = 17
    num_actions = 6
    observation_names = (*(f"qpos_{i}" for i in range(1, 9)), *(f"qvel_{i}" for i in range(9)))

    class Params(StrictModel):
        """Parameters of the task, with Gymnasium's names."""

        forward_reward_weight: float = Field(1.0, description="Reward on the speed along x [s/m].")
        ctrl_cost_weight: float = Field(0.1, ge=0, description="Penalty on the sum of squared actions.")
        reset_noise_scale: float = Field(
            0.1, ge=0, description="Half-width of position noise; standard deviation of velocity noise."
        )

    params: Params

    def columns(self) -> list[Tensor]:
        """Return the parts of the observation: joint positions without x, and velocities. (num_envs, k) each"""
        return [self.field.qpos[:, 1:], self.field.qvel]

    def compute_reward(self) -> Tensor:
        """Return the reward: speed, minus the cost of actions. (num_envs,)"""
        params = self.params
        return params.forward_reward_weight * self.speed() - self.action_cost(params.ctrl_cost_weight)

    def start(self, selection: Selection) -> tuple[Tensor, Tensor]:
        """Sample positions uniformly, velocities from a Gaussian, around the default state. (rows, nq), (rows, nv)"""
        return self.gaussian_start(selection, self.params.reset_noise_scale)


class Swimmer(HalfCheetah):
    """Swimmer-v5: three links in a viscous fluid."""

    num_observations = 8
    num_actions = 2
    observation_names = (*(f"qpos_{i}" for i in range(2, 5)), *(f"qvel_{i}" for i in range(5)))

    class Params(StrictModel):
        """Parameters of the task, with Gymnasium's names."""

        forward_reward_weight: float = Field(1.0, description="Reward on the speed along x [s/m].")
        ctrl_cost_weight: float = Field(1e-4, ge=0, description="Penalty on the sum of squared actions.")
        reset_noise_scale: float = Field(
            0.1, ge=0, description="Half-width of the uniform noise on initial positions and velocities."
        )

    params: Params

    def columns(self) -> list[Tensor]:
        """Return the parts of the observation: joint positions without x and y, and velocities. (num_envs, k) each"""
        return [self.field.qpos[:, 2:], self.field.qvel]

    def start(self, selection: Selection) -> tuple[Tensor, Tensor]:
        """Sample positions and velocities uniformly around the default state. (rows, nq), (rows, nv)"""
        return self.uniform_start(selection, self.params.reset_noise_scale)


class Walker2d(GymnasiumTask):
    """Walker2d-v5: two legs in a plane."""

    moves = True
    num_observations = 17
    num_actions = 6
    observation_names = (*(f"qpos_{i}" for i in range(1, 9)), *(f"qvel_{i}" for i in range(9)))

    class Params(StrictModel):
        """Parameters of the task, with Gymnasium's names."""

        forward_reward_weight: float = Field(1.0, description="Reward on the speed along x [s/m].")
        ctrl_cost_weight: float = Field(1e-3, ge=0, description="Penalty on the sum of squared actions.")
        healthy_reward: float = Field(1.0, description="Reward of a step that does not end the episode.")
        healthy_z_range: tuple[float, float] = Field(
            (0.8, 2.0), description="Range of the torso's height; outside it the episode terminates [m]."
        )
        healthy_angle_range: tuple[float, float] = Field((-1.0, 1.0), description="Range of the torso's pitch [rad].")
        reset_noise_scale: float = Field(
            5e-3, ge=0, description="Half-width of the uniform noise on initial positions and velocities."
        )

    params: Params

    def columns(self) -> list[Tensor]:
        """Return the observation: joint positions without x, and velocities clipped to +-10. (num_envs, k) each"""
        return [self.field.qpos[:, 1:], self.field.qvel.clamp(-10.0, 10.0)]

    def healthy(self) -> Tensor:
        """Return whether height and pitch are in range. (num_envs,) bool"""
        height, angle = self.field.qpos[:, 1], self.field.qpos[:, 2]
        return within(height, *self.params.healthy_z_range) & within(angle, *self.params.healthy_angle_range)

    def compute_reward(self) -> Tensor:
        """Return the reward: speed and a bonus for health, minus the cost of actions. (num_envs,)"""
        params = self.params
        gains = params.forward_reward_weight * self.speed() + ~self.ended * params.healthy_reward
        return gains - self.action_cost(params.ctrl_cost_weight)

    def check_termination(self) -> None:
        """Terminate where the robot is not healthy."""
        torch.logical_not(self.healthy(), out=self.ended)

    def start(self, selection: Selection) -> tuple[Tensor, Tensor]:
        """Sample positions and velocities uniformly around the default state. (rows, nq), (rows, nv)"""
        return self.uniform_start(selection, self.params.reset_noise_scale)


class Hopper(Walker2d):
    """Hopper-v5: one leg in a plane."""

    num_observations = 11
    num_actions = 3
    observation_names = (*(f"qpos_{i}" for i in range(1, 6)), *(f"qvel_{i}" for i in range(6)))

    class Params(StrictModel):
        """Parameters of the task, with Gymnasium's names."""

        forward_reward_weight: float = Field(1.0, description="Reward on the speed along x [s/m].")
        ctrl_cost_weight: float = Field(1e-3, ge=0, description="Penalty on the sum of squared actions.")
        healthy_reward: float = Field(1.0, description="Reward of a step that does not end the episode.")
        healthy_state_range: tuple[float, float] = Field(
            (-100.0, 100.0), description="Range of all positions and velocities except x and z."
        )
        healthy_z_range: tuple[float, float | None] = Field(
            (0.7, None),
            description="Range of the torso's height; outside it the episode terminates [m]; null: no upper end.",
        )
        healthy_angle_range: tuple[float, float] = Field((-0.2, 0.2), description="Range of the torso's pitch [rad].")
        reset_noise_scale: float = Field(
            5e-3, ge=0, description="Half-width of the uniform noise on initial positions and velocities."
        )

    params: Params

    def healthy(self) -> Tensor:
        """Return whether height, pitch and all other state values are in range. (num_envs,) bool"""
        params, qpos = self.params, self.field.qpos
        low, high = params.healthy_z_range
        state = torch.cat([qpos[:, 2:], self.field.qvel], dim=1)
        healthy = within(state, *params.healthy_state_range).all(dim=1)
        healthy &= qpos[:, 1] > low if high is None else within(qpos[:, 1], low, high)
        return healthy & within(qpos[:, 2], *params.healthy_angle_range)


__all__ = ["Ant", "HalfCheetah", "Hopper", "Swimmer", "Walker2d"]
