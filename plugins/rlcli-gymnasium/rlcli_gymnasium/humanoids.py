"""Gymnasium's humanoid and humanoid stand-up: walk, and get up from the ground."""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor

from rlcli.config.schema import StrictModel
from rlcli.sim.env_selection import Selection

from .base import GymnasiumTask, square_sum, within

_BODIES = range(1, 14)
_NAMES = (
    *(f"qpos_{i}" for i in range(2, 24)),
    *(f"qvel_{i}" for i in range(23)),
    *(f"cinert_{body}_{i}" for body in _BODIES for i in range(10)),
    *(f"cvel_{body}_{i}" for body in _BODIES for i in range(6)),
    *(f"qfrc_actuator_{i}" for i in range(6, 23)),
    *(f"cfrc_ext_{body}_{i}" for body in _BODIES for i in range(6)),
)


class _Humanoid(GymnasiumTask):
    """Base class of both humanoid tasks: observations, initial states and costs."""

    num_observations = 348
    num_actions = 17
    observation_names = _NAMES
    reads = ("xipos", "cinert", "cvel", "qfrc_actuator", "cfrc_ext")

    def columns(self) -> list[Tensor]:
        """Return the observation: qpos without x, y; qvel; inertia, velocity, forces of bodies. (num_envs, k) each"""
        field = self.field
        return [
            field.qpos[:, 2:],
            field.qvel,
            field.cinert[:, 1:].flatten(1),
            field.cvel[:, 1:].flatten(1),
            field.qfrc_actuator[:, 6:],
            field.cfrc_ext[:, 1:].flatten(1),
        ]

    def start(self, selection: Selection) -> tuple[Tensor, Tensor]:
        """Sample positions and velocities uniformly around the default state. (rows, nq), (rows, nv)"""
        return self.uniform_start(selection, self.params.reset_noise_scale)

    def control_cost(self) -> Tensor:
        """Return the weighted sum of squared controls, read from the engine. (num_envs,)"""
        return self.params.ctrl_cost_weight * square_sum(self.field.ctrl.contiguous())

    def force_cost(self, weight: float, bounds: tuple[float | None, float | None]) -> Tensor:
        """Return the weighted sum of squared contact forces, clipped to `bounds`; None: no bound. (num_envs,)"""
        low, high = bounds
        return (weight * square_sum(self.field.cfrc_ext)).clamp(low, high)


class Humanoid(_Humanoid):
    """Humanoid-v5: walk along x."""

    moves = True

    class Params(StrictModel):
        """Parameters of the task, with Gymnasium's names."""

        ctrl_cost_weight: float = Field(0.1, ge=0, description="Penalty on the sum of squared controls.")
        reset_noise_scale: float = Field(
            0.01, ge=0, description="Half-width of the uniform noise on initial positions and velocities."
        )
        forward_reward_weight: float = Field(1.25, description="Reward on the speed of the centre of mass [s/m].")
        contact_cost_weight: float = Field(5e-7, ge=0, description="Penalty on the sum of squared contact forces.")
        contact_cost_range: tuple[float | None, float | None] = Field(
            (None, 10.0), description="Lower and upper bound of the penalty on contact forces; null: no bound."
        )
        healthy_reward: float = Field(5.0, description="Reward of a step that does not end the episode.")
        healthy_z_range: tuple[float, float] = Field(
            (1.0, 2.0), description="Range of the torso's height; outside it the episode terminates [m]."
        )

    params: Params

    def post_reset(self) -> None:
        """Compute the bodies' shares of the mass, from which `progress` computes the centre of mass."""
        mass = torch.tensor(self.env.engine.model.body_mass, dtype=torch.float64)
        self.share = (mass / mass.sum()).to(self.env.engine.field("qpos"))
        super().post_reset()

    def progress(self) -> Tensor:
        """Return x of the centre of mass; as in Gymnasium, it lags by one physics step. (num_envs,) [m]"""
        return (self.field.xipos[:, :, 0] * self.share).sum(dim=1)

    def healthy(self) -> Tensor:
        """Return whether the torso's height is in range. (num_envs,) bool"""
        return within(self.field.qpos[:, 2], *self.params.healthy_z_range)

    def compute_reward(self) -> Tensor:
        """Return the reward: speed and a bonus for health, minus the costs of controls and contacts. (num_envs,)"""
        params = self.params
        gains = params.forward_reward_weight * self.speed() + ~self.ended * params.healthy_reward
        contact_cost = self.force_cost(params.contact_cost_weight, params.contact_cost_range)
        return gains - (self.control_cost() + contact_cost)

    def check_termination(self) -> None:
        """Terminate where the robot is not healthy."""
        torch.logical_not(self.healthy(), out=self.ended)


class HumanoidStandup(_Humanoid):
    """HumanoidStandup-v5: get up."""

    class Params(StrictModel):
        """Parameters of the task, with Gymnasium's names."""

        ctrl_cost_weight: float = Field(0.1, ge=0, description="Penalty on the sum of squared controls.")
        reset_noise_scale: float = Field(
            0.01, ge=0, description="Half-width of the uniform noise on initial positions and velocities."
        )
        uph_cost_weight: float = Field(
            1.0, description="Reward on the torso's height divided by the physics step [s/m]."
        )
        impact_cost_weight: float = Field(5e-7, ge=0, description="Penalty on the sum of squared contact forces.")
        impact_cost_range: tuple[float | None, float | None] = Field(
            (None, 10.0), description="Lower and upper bound of the penalty on contact forces; null: no bound."
        )

    params: Params

    def compute_reward(self) -> Tensor:
        """Return the reward for height, minus the costs of controls and contact forces, plus 1. (num_envs,)

        The reward for height is `uph_cost_weight` times the height of the torso, divided by the physics step [s].
        """
        params = self.params
        height = params.uph_cost_weight * self.field.qpos[:, 2] / self.env.physics_dt
        return height - self.control_cost() - self.force_cost(params.impact_cost_weight, params.impact_cost_range) + 1


__all__ = ["Humanoid", "HumanoidStandup"]
