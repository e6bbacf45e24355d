"""Gymnasium's inverted pendulum and inverted double pendulum: balance one pole or two on a cart."""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor

from rlcli.config.schema import StrictModel
from rlcli.sim.env_selection import Selection

from .base import GymnasiumTask


class InvertedPendulum(GymnasiumTask):
    """InvertedPendulum-v5: one pole."""

    num_observations = 4
    num_actions = 1
    observation_names = ("cart_pos", "pole_pos", "cart_vel", "pole_vel")
    observation_units = ("m", "rad", "m/s", "rad/s")

    class Params(StrictModel):
        """Parameters of the task, with Gymnasium's names."""

        reset_noise_scale: float = Field(
            0.01, ge=0, description="Half-width of the uniform noise on initial positions and velocities."
        )

    params: Params

    def columns(self) -> list[Tensor]:
        """Return the parts of the observation: joint positions and velocities. (num_envs, k) each"""
        return [self.field.qpos, self.field.qvel]

    def compute_reward(self) -> Tensor:
        """Return the reward: 1, or 0 where the pole has fallen. (num_envs,)"""
        return ~self.ended

    def check_termination(self) -> None:
        """Terminate where the pole leans by more than 0.2 rad. Non-finite states end the episode before this check."""
        torch.gt(self.observation[:, 1].abs(), 0.2, out=self.ended)

    def start(self, selection: Selection) -> tuple[Tensor, Tensor]:
        """Sample positions and velocities uniformly around the default state. (rows, nq), (rows, nv)"""
        return self.uniform_start(selection, self.params.reset_noise_scale)


class InvertedDoublePendulum(GymnasiumTask):
    """InvertedDoublePendulum-v5: a pole on a pole."""

    num_observations = 9
    num_actions = 1
    observation_names = (
        *("cart_pos", "sin_1", "sin_2", "cos_1", "cos_2"),
        *("cart_vel", "vel_1", "vel_2", "cart_constraint_force"),
    )
    observation_units = ("m", "", "", "", "", "m/s", "rad/s", "rad/s", "N")
    reads = ("site_xpos", "qfrc_constraint")

    class Params(StrictModel):
        """Parameters of the task, with Gymnasium's names."""

        healthy_reward: float = Field(10.0, description="Reward of a step that does not end the episode.")
        reset_noise_scale: float = Field(
            0.1, ge=0, description="Half-width of position noise; standard deviation of velocity noise."
        )

    params: Params

    def columns(self) -> list[Tensor]:
        """Return the observation: cart, sines and cosines of angles, velocities, cart's force. (num_envs, k) each"""
        qpos, force = self.field.qpos, self.field.qfrc_constraint[:, :1]
        angles = qpos[:, 1:]
        return [qpos[:, :1], angles.sin(), angles.cos(), self.field.qvel.clamp(-10.0, 10.0), force.clamp(-10.0, 10.0)]

    def compute_reward(self) -> Tensor:
        """Return `healthy_reward`, minus costs of the tip's distance from its goal and of pole speeds. (num_envs,)"""
        x, height = self.field.site_xpos[:, 0, 0], self.field.site_xpos[:, 0, 2]
        first, second = self.field.qvel[:, 1], self.field.qvel[:, 2]
        distance = 0.01 * x.square() + (height - 2).square()
        rates = 0.001 * first.square() + 0.005 * second.square()
        return self.params.healthy_reward * (~self.ended) - distance - rates

    def check_termination(self) -> None:
        """Terminate where the tip is at or below 1 m; as in Gymnasium, its position lags by one physics step."""
        torch.le(self.field.site_xpos[:, 0, 2], 1, out=self.ended)

    def start(self, selection: Selection) -> tuple[Tensor, Tensor]:
        """Sample positions uniformly, velocities from a Gaussian, around the default state. (rows, nq), (rows, nv)"""
        return self.gaussian_start(selection, self.params.reset_noise_scale)


__all__ = ["InvertedDoublePendulum", "InvertedPendulum"]
