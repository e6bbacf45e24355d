"""Crazyflie in the direct workflow: rise to a point and stay there, with four motors that follow slowly."""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor

from rlcli.sim.env_selection import Selection
from rlcli.sim.rotations import axes, length
from rlcli_tasks.flight import FlightTask

MOTORS = ("m1", "m2", "m3", "m4")


class CrazyflieTask(FlightTask):
    """Hover at the target. Observations: docs/reference/zoo/crazyflie.md lists the 18 columns."""

    num_observations = 18
    num_actions = 4
    observation_names = (
        *("to_target_x", "to_target_y", "to_target_z"),
        *(f"{axis}_axis_{part}" for axis in "xyz" for part in "xyz"),
        *("vel_x", "vel_y", "vel_z", "rate_x", "rate_y", "rate_z"),
    )
    observation_units = (*("m",) * 3, *("",) * 9, *("m/s",) * 3, *("rad/s",) * 3)
    action_names = MOTORS
    motors = False

    class Params(FlightTask.Params):
        """Parameters of the task, set in the section `params:` of its YAML."""

        thrust_to_weight: float = Field(
            1.9, gt=1, description="Thrust of all four motors at full speed, divided by the weight."
        )
        motor_time: float = Field(0.15, gt=0, description="Settling time of a motor's speed: four time constants [s].")
        thrust_noise: float = Field(
            0.01, ge=0, description="Standard deviation of the thrust noise, divided by the commanded thrust."
        )
        target_low: tuple[float, float, float] = Field(
            (0.0, 0.0, 2.0), description="Lower corner of the box from which targets are sampled: x, y, z [m]."
        )
        target_high: tuple[float, float, float] = Field(
            (0.0, 0.0, 2.0), description="Upper corner of the box from which targets are sampled: x, y, z [m]."
        )
        height_range: tuple[float, float] = Field(
            (0.5, 5.0), description="An episode fails if the drone's height is outside this range: lowest, highest [m]."
        )
        effort_cost: float = Field(
            0.05, description="Weight of the penalty exp(-sum of squared actions / 2), which is largest at action 0."
        )

    params: Params

    def post_reset(self) -> None:
        """Create constants, and buffers that the other methods write in place."""
        super().post_reset()
        params, n, model = self.params, self.num_envs, self.env.engine.model
        weight = float(model.body_mass[self.robot.body_ids].sum()) * -float(model.opt.gravity[2])
        self.max_thrust = params.thrust_to_weight * weight / len(MOTORS)
        """Maximum thrust of a motor [N]."""
        self.follow = min(4.0 * self.step_dt / params.motor_time, 1.0)
        """Fraction of the speed error that a motor corrects in one step."""
        self.everywhere = torch.ones(n, dtype=torch.bool, device=self.device)
        self.actions = torch.zeros(n, len(MOTORS), device=self.device)
        self.up = torch.zeros(n, device=self.device)
        """z component of the robot's z axis in the world frame (1: upright), set by `get_observations`. (num_envs,)"""
        self.speeds = torch.zeros(n, len(MOTORS), device=self.device)
        """Motor speeds, divided by the highest speed. (num_envs, 4)"""

    def reset(self, selection: Selection) -> None:
        """Put the drone below the target, level and at rest, with motors off."""
        super().reset(selection)
        selection.write(self.actions, 0.0)
        selection.write(self.speeds, 0.0)

    def pre_physics_step(self, actions: Tensor) -> None:
        """Apply the thrusts that the actions command.

        The speed of a motor follows its command with a lag, and the thrust is proportional to the square of the speed.
        """
        self.move_target()
        self.actions.copy_(actions)
        command = (actions + 1.0).mul_(0.5).clamp_(0.0, 1.0)
        self.speeds.lerp_(command.sqrt(), self.follow)
        everyone = self.selection(self.everywhere, "thrust")
        assert everyone is not None
        noise = everyone.normal(0.0, self.params.thrust_noise, (len(MOTORS),))
        thrusts = torch.addcmul(self.speeds.square(), command, noise).clamp_(0.0, 1.0)
        self.env.engine.field("ctrl").copy_(thrusts.mul_(self.max_thrust))

    def get_observations(self) -> None:
        """Write the observations to `obs_buf`."""
        data = self.robot.data
        torch.sub(self.target, data.root_pos_w, out=self.to_target)
        robot_axes = axes(data.root_quat_w)
        self.up.copy_(robot_axes[:, 8])
        torch.cat(
            [self.to_target, robot_axes, data.root_lin_vel_w, data.root_ang_vel_w],
            dim=1,
            out=self.obs_buf,
        )

    def calculate_metrics(self) -> None:
        """Reward nearness to the target, and near the target an upright pose without spin.

        The penalty on actions is largest at action 0.
        """
        self.distance.copy_(length(self.to_target))
        near = (1.0 + self.distance).reciprocal_()
        up = self.up.clamp(0.0, 1.0)
        still = (-self.robot.data.root_ang_vel_w.square().sum(dim=1)).exp_()
        low_effort = (-0.5 * self.actions.square().sum(dim=1)).exp_()
        reward = torch.addcmul(near, near, up.add_(still, alpha=0.01))
        self.rew_buf.copy_(reward.sub_(low_effort, alpha=self.params.effort_cost))

    def is_done(self) -> None:
        """Terminate where the drone is too far, too low, too high or upside down. The environment adds time-outs."""
        low, high = self.params.height_range
        height = self.robot.data.root_pos_w[:, 2]
        outside = (height < low) | (height > high)
        self.reset_buf.copy_((self.distance > self.params.max_distance) | outside | (self.up < 0.0))
