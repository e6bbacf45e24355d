"""Ingenuity in the direct workflow: fly from point to point on Mars, with two rotors that push along and sideways."""

from __future__ import annotations

import math

import torch
from pydantic import Field
from torch import Tensor

from rlcli.sim.rotations import length
from rlcli_tasks.flight import FlightTask

ROTORS = ("lower", "upper")


class IngenuityTask(FlightTask):
    """Fly from target to target. Observations: docs/reference/zoo/ingenuity.md lists the 13 columns."""

    num_observations = 13
    num_actions = 6
    observation_names = (
        *("to_target_x", "to_target_y", "to_target_z", "quat_w", "quat_x", "quat_y", "quat_z"),
        *("vel_x", "vel_y", "vel_z", "rate_x", "rate_y", "rate_z"),
    )
    observation_units = (*("3 m",) * 3, *("",) * 4, *("2 m/s",) * 3, *("pi rad/s",) * 3)
    action_names = tuple(f"{rotor}_{part}" for rotor in ROTORS for part in ("x", "y", "thrust"))
    motors = False

    class Params(FlightTask.Params):
        """Parameters of the task, set in the section `params:` of its YAML."""

        max_thrust: float = Field(20.0, gt=0, description="Largest thrust of a rotor, upwards or downwards [N].")
        lateral: float = Field(
            0.2, ge=0, description="Largest sideways force of a rotor along each of x and y, divided by its thrust."
        )
        target_low: tuple[float, float, float] = Field(
            (-1.0, -1.0, 1.0), description="Lower corner of the box from which targets are sampled: x, y, z [m]."
        )
        target_high: tuple[float, float, float] = Field(
            (1.0, 1.0, 2.0), description="Upper corner of the box from which targets are sampled: x, y, z [m]."
        )
        start_offset: float = Field(
            0.5, ge=0, description="Largest absolute initial offset from the default position, along each axis [m]."
        )
        max_distance: float = Field(
            20.0, gt=0, description="An episode fails if the robot is farther than this from the target [m]."
        )
        min_height: float = Field(0.5, description="An episode fails if the robot is lower than this [m].")
        steadiness: float = Field(
            0.0,
            ge=0,
            description=(
                "Weight of the reward term n / (1 + 10 v^2), with n = 1 / (1 + 2.5 d^2), speed v [m/s] and "
                "distance to the target d [m]; the original reward lacks this term."
            ),
        )

    params: Params

    def post_reset(self) -> None:
        """Create constants, and buffers that the other methods write in place."""
        super().post_reset()
        self.forces = torch.zeros(self.num_envs, len(ROTORS), 3, device=self.device)
        """Force of each rotor, in the rotor's frame. (num_envs, 2, 3) [N]"""
        self.units = torch.tensor([3.0] * 3 + [1.0] * 4 + [2.0] * 3 + [math.pi] * 3, device=self.device)
        """Divisors of the observation's columns: a column is 1 if its quantity has this value. (13,)"""

    def pre_physics_step(self, actions: Tensor) -> None:
        """Apply the force of each rotor: a thrust, and along x and y a fraction of the thrust."""
        self.move_target()
        command = actions.view(-1, len(ROTORS), 3).clamp(-1.0, 1.0)
        thrust = command[..., 2:] * self.params.max_thrust
        torch.mul(command[..., :2], thrust * self.params.lateral, out=self.forces[..., :2])
        self.forces[..., 2:].copy_(thrust)
        self.env.engine.field("ctrl").copy_(self.forces.view(-1, 6))

    def get_observations(self) -> None:
        """Write the observations to `obs_buf`."""
        data = self.robot.data
        torch.sub(self.target, data.root_pos_w, out=self.to_target)
        torch.cat(
            [self.to_target, data.root_quat_w, data.root_lin_vel_w, data.root_ang_vel_w],
            dim=1,
            out=self.obs_buf,
        ).div_(self.units)

    def calculate_metrics(self) -> None:
        """Reward nearness to the target, and near it an upright pose, no spin and (`steadiness`) a low speed."""
        data = self.robot.data
        self.distance.copy_(length(self.to_target))
        _, x, y, _ = data.root_quat_w.unbind(dim=1)
        tilt = 2.0 * torch.addcmul(x * x, y, y)  # 1 - cos of the angle between up and the vertical
        spin = data.root_ang_vel_w[:, 2]
        near = 1.0 / (1.0 + 2.5 * self.distance.square())
        posture = 1.0 / (1.0 + 30.0 * tilt.square()) + 1.0 / (1.0 + 10.0 * spin.square())
        self.rew_buf.copy_(near + near * posture)
        if self.params.steadiness:  # without it a sway of 10 cm costs only 2 % of the reward
            rest = 1.0 / (1.0 + 10.0 * data.root_lin_vel_w.square().sum(dim=1))
            self.rew_buf.addcmul_(near, rest, value=self.params.steadiness)

    def is_done(self) -> None:
        """Terminate where the robot is too far or too low. The environment adds time-outs."""
        low = self.robot.data.root_pos_w[:, 2] < self.params.min_height
        self.reset_buf.copy_((self.distance > self.params.max_distance) | low)
