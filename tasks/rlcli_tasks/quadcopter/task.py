"""Quadcopter in the direct workflow: fly to a point and stay there, with four thrusts and eight rotor tilts.

The methods of the class can also run as a CUDA graph on a GPU: they read no value back, select environments by masks
instead of indices, and write tensors that are kept between steps in place.
"""

from __future__ import annotations

import math

import torch
from pydantic import Field
from torch import Tensor

from rlcli.config.schema import StrictModel
from rlcli.envs.direct import DirectTask
from rlcli.sim.env_selection import Selection
from rlcli.sim.rotations import length

ROTORS = ("fl", "bl", "br", "fr")
JOINTS = tuple(f"{joint}_{rotor}" for rotor in ROTORS for joint in ("pitch", "roll"))
THRUSTS = tuple(f"thrust_{rotor}" for rotor in ROTORS)


class QuadcopterTask(DirectTask):
    """Hover at the target. Observations: docs/reference/zoo/quadcopter.md lists the 21 columns."""

    num_observations = 21
    num_actions = 12
    observation_names = (
        *("to_target_x", "to_target_y", "to_target_z", "quat_w", "quat_x", "quat_y", "quat_z"),
        *("vel_x", "vel_y", "vel_z", "rate_x", "rate_y", "rate_z"),
        *(f"{joint}_pos" for joint in JOINTS),
    )
    observation_units = (*("3 m",) * 3, *("",) * 4, *("2 m/s",) * 3, *("pi rad/s",) * 3, *("rad",) * 8)
    action_names = (*JOINTS, *THRUSTS)
    motors = False

    class Params(StrictModel):
        """Parameters of the task, set in the section `params:` of its YAML."""

        tilt_speed: float = Field(
            25.132741, gt=0, description="Speed of the target of a rotor's tilt angle at action 1: 8 pi [rad/s]."
        )
        thrust_speed: float = Field(100.0, gt=0, description="Rate of change of a rotor's thrust at action 1 [N/s].")
        max_thrust: float = Field(2.0, gt=0, description="Largest thrust of a rotor, upwards or downwards [N].")
        max_distance: float = Field(
            3.0, gt=0, description="An episode fails if the robot is farther than this from the target [m]."
        )
        min_height: float = Field(0.3, description="An episode fails if the robot is lower than this [m].")
        start_low: tuple[float, float, float] = Field(
            (-1.5, -1.5, -0.2), description="Lower bounds of the initial offset from the default position: x, y, z [m]."
        )
        start_high: tuple[float, float, float] = Field(
            (1.5, 1.5, 1.5), description="Upper bounds of the initial offset from the default position: x, y, z [m]."
        )
        joint_pos_noise: float = Field(
            0.2, ge=0, description="Largest absolute initial tilt angle of a rotor, within the joint limits [rad]."
        )

    params: Params

    def post_reset(self) -> None:
        """Create constants, and buffers that the other methods write in place."""
        params, n = self.params, self.num_envs
        self.robot, self.goal = self.env.entities["robot"], self.env.entities["target"]
        low, high = self.robot.data.joint_pos_limits.to(self.device).unbind(dim=1)
        noise = params.joint_pos_noise
        self.tilt_low, self.tilt_high = low.clamp(min=-noise), high.clamp(max=noise)
        self.start_low = torch.tensor(params.start_low, device=self.device)
        self.start_high = torch.tensor(params.start_high, device=self.device)
        rates = [params.tilt_speed] * len(JOINTS) + [params.thrust_speed] * len(THRUSTS)
        self.steps = torch.tensor([self.step_dt * rate for rate in rates], device=self.device)
        """Change of each element of `controls` in one environment step at action 1. (12,)"""
        thrusts = torch.full((len(THRUSTS),), params.max_thrust, device=self.device)
        self.lowest, self.highest = torch.cat([low, -thrusts]), torch.cat([high, thrusts])
        self.controls = torch.zeros(n, self.num_actions, device=self.device)
        """Target angles of the servos that tilt the rotors [rad], then thrusts [N]. (num_envs, 12)"""
        self.tilts, self.thrusts = self.controls.split([len(JOINTS), len(THRUSTS)], dim=1)
        self.units = torch.tensor([3.0] * 3 + [1.0] * 4 + [2.0] * 3 + [math.pi] * 3 + [1.0] * 8, device=self.device)
        """Divisors of the observation's columns: a column is 1 if its quantity has this value. (21,)"""
        self.to_target = torch.zeros(n, 3, device=self.device)
        """Vector from the robot to the target in the world frame, set by `get_observations`. (num_envs, 3) [m]"""
        self.distance = torch.zeros(n, device=self.device)
        self.extras["distance"] = self.distance  # distance to the target [m]

    def reset(self, selection: Selection) -> None:
        """Put the robot near the target, level and at rest, with tilted rotors and no thrust."""
        default = selection.read_view(self.robot.data.default_root_state)
        position = default[:, :3] + selection.uniform(self.start_low, self.start_high, (3,))
        tilts = selection.uniform(self.tilt_low, self.tilt_high, (len(JOINTS),))
        self.robot.write_root_pose(selection, position, default[:, 3:7])
        self.robot.write_joint_positions(selection, tilts)
        selection.write(self.tilts, tilts)
        selection.write(self.thrusts, 0.0)

    def pre_physics_step(self, actions: Tensor) -> None:
        """Change the target tilts and the thrusts by the actions, which are rates of change, within their limits."""
        self.controls.addcmul_(actions, self.steps)
        torch.clamp(self.controls, self.lowest, self.highest, out=self.controls)
        self.env.engine.field("ctrl").copy_(self.controls)

    def get_observations(self) -> None:
        """Write the observations to `obs_buf`."""
        data = self.robot.data
        torch.sub(self.goal.data.root_pos_w, data.root_pos_w, out=self.to_target)
        torch.cat(
            [self.to_target, data.root_quat_w, data.root_lin_vel_w, data.root_ang_vel_w, data.joint_pos],
            dim=1,
            out=self.obs_buf,
        ).div_(self.units)

    def calculate_metrics(self) -> None:
        """Reward nearness to the target, and near the target an upright pose without spin."""
        data = self.robot.data
        self.distance.copy_(length(self.to_target))
        _, x, y, _ = data.root_quat_w.unbind(dim=1)
        tilt = 2.0 * torch.addcmul(x * x, y, y)  # 1 - cos of the angle between up and the vertical
        spin = data.root_ang_vel_w[:, 2].square()
        near = 1.0 / (1.0 + 3.0 * self.distance.square())
        posture = 1.0 / (1.0 + 10.0 * tilt.square()) + 1.0 / (1.0 + 0.001 * spin) - spin / 400.0
        torch.clamp(near + near * posture, min=0.0, out=self.rew_buf)

    def is_done(self) -> None:
        """Terminate where the robot is too far or too low. The environment adds time-outs."""
        low = self.robot.data.root_pos_w[:, 2] < self.params.min_height
        self.reset_buf.copy_((self.distance > self.params.max_distance) | low)
