"""Base class of the direct locomotion tasks: a robot with a torso, joints and feet runs to a far target.

The methods of the class can also run as a CUDA graph on a GPU: they read no value back, select environments by masks
instead of indices, write tensors that are kept between steps in place, and create few tensors.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from pydantic import Field
from torch import Tensor

from rlcli.config.schema import StrictModel
from rlcli.envs.articulation import ArticulationView
from rlcli.envs.direct import DirectTask
from rlcli.sim.env_selection import Selection
from rlcli.sim.rotations import atan2

_WRENCH = ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z")

HEIGHT, UP, HEADING = 0, 10, 11
"""Columns of the observation that rewards and terminations read: the torso's height [m], up and heading (cosines)."""
_JOINTS_FROM = 12


def observation_names(joints: tuple[str, ...], feet: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the columns of the observation, for a robot with these joints and feet."""
    return (
        *("height", "vel_x", "vel_y", "vel_z", "rate_x", "rate_y", "rate_z", "yaw", "roll", "target_angle"),
        *("up", "heading"),
        *(f"{joint}_pos" for joint in joints),
        *(f"{joint}_vel" for joint in joints),
        *(f"{foot}_{part}" for foot in feet for part in _WRENCH),
        *(f"{joint}_action" for joint in joints),
    )


def observation_units(joints: int, feet: int, *, rate: str, joint_rate: str, force: str) -> tuple[str, ...]:
    """Return the units of the observation's columns, some of which are scaled: with `4 rad/s`, 1 means 4 rad/s.

    Args:
        joints: number of joints.
        feet: number of feet.
        rate: unit of the torso's angular velocity, such as `4 rad/s`.
        joint_rate: unit of the joints' angular velocities.
        force: number of N or N m that is observed as 1.
    """
    return (
        *("m", "m/s", "m/s", "m/s", rate, rate, rate, "rad", "rad", "rad", "", ""),
        *("half range",) * joints,
        *(joint_rate,) * joints,
        *((f"{force} N",) * 3 + (f"{force} N m",) * 3) * feet,
        *("",) * joints,
    )


class LocomotionTask(DirectTask):
    """Base class of tasks in which a robot runs towards a target.

    A subclass defines the joints, their torques and the scales of observations. Its `Params` add
    `termination_height`, `death_reward`, `alive_weight`, `action_cost`, `energy_cost`, `limit_cost` and
    `joint_pos_noise`, whose values depend on the robot.
    """

    class Params(StrictModel):
        """Parameters that all locomotion tasks have, set in the section `params:` of their YAML."""

        target: tuple[float, float] = Field((1000.0, 0.0), description="Position of the target: x, y [m].")
        progress_weight: float = Field(1.0, description="Weight of the reward on the speed towards the target [s/m].")
        up_weight: float = Field(
            0.1,
            description="Reward per step in which the torso is tilted by less than acos(0.93) = 0.38 rad from upright.",
        )
        heading_weight: float = Field(
            0.5,
            description=(
                "Reward per step in which the torso's heading is within acos(0.8) = 0.64 rad of the direction "
                "to the target; with a larger angle a, this reward x cos(a) / 0.8."
            ),
        )
        joint_vel_noise: float = Field(0.1, ge=0, description="Largest absolute initial joint velocity [rad/s].")

    joints: ClassVar[tuple[str, ...]]
    """Joint names in the order of observations and actions, which is the model's order."""
    rate_scale: ClassVar[float]
    """Factor on the torso's angular velocity in observations."""
    joint_vel_scale: ClassVar[float]
    """Factor on joint velocities in observations."""
    force_scale: ClassVar[float]
    """Factor on forces and torques of the feet in observations."""

    params: Any

    def efforts(self) -> tuple[float, ...]:
        """Return the torque of each joint at action 1 [N m]."""
        raise NotImplementedError

    def at_limits(self, position: Tensor) -> Tensor:
        """Return the cost of each joint near a limit, without the weight `limit_cost`. (num_envs, joints)

        position: joint positions scaled so that -1 and 1 are the limits. (num_envs, joints)
        """
        raise NotImplementedError

    def set_up_scene(self, scene) -> None:
        """Register a view of the robots: their state in all environments, as tensors."""
        self.robots = scene.add(ArticulationView("robot"))

    def post_reset(self) -> None:
        """Create constants, and buffers that the other methods write in place."""
        self.robot = self.env.entities["robot"]
        data, params, n, k = self.robot.data, self.params, self.num_envs, len(self.joints)
        self.joint_pos = slice(_JOINTS_FROM, _JOINTS_FROM + k)
        self.joint_vel = slice(_JOINTS_FROM + k, _JOINTS_FROM + 2 * k)
        self.effort = torch.tensor(self.efforts(), device=self.device)
        self.share = self.effort / self.effort.max()
        self.energy_cost = params.energy_cost * self.share
        low, high = data.joint_pos_limits.to(self.device).unbind(dim=1)
        self.position_scale = 2.0 / (high - low)
        self.position_offset = (low + high) / (low - high)
        default = data.default_joint_pos[0]
        self.start_low, self.start_high = default - params.joint_pos_noise, default + params.joint_pos_noise
        self.low, self.high = low, high
        self.target = torch.tensor(params.target, device=self.device)
        self.start = data.default_root_state[:, :2]
        self.position_before = self.start.clone()
        self.start_distance = torch.linalg.vector_norm(self.target - self.start, dim=1)
        self.distance, self.distance_before = self.start_distance.clone(), self.start_distance.clone()
        self.speed = torch.zeros(n, device=self.device)
        self.extras["speed"] = self.speed  # speed towards the target [m/s]
        self.actions = torch.zeros(n, self.num_actions, device=self.device)
        # rows to rotate into the torso's frame: its velocity and the world's three axes
        self.seen = torch.cat([torch.zeros(1, 3), torch.eye(3)]).to(self.device).repeat(n, 1, 1)

    def reset(self, selection: Selection) -> None:
        """Put the torso at its initial pose, at rest, and the joints near their defaults, within their limits."""
        noise = self.params.joint_vel_noise
        shape = (self.num_actions,)
        position = selection.uniform(self.start_low, self.start_high, shape).clamp_(self.low, self.high)
        self.robot.write_joint_positions(selection, position)
        self.robot.write_joint_velocities(selection, selection.uniform(-noise, noise, shape))
        selection.write(self.position_before, selection.read(self.start))
        selection.write(self.distance_before, selection.read(self.start_distance))
        selection.write(self.actions, 0.0)

    def pre_physics_step(self, actions: Tensor) -> None:
        """Apply the actions as torques of the joints."""
        self.actions.copy_(actions)
        self.robots.set_joint_efforts(self.effort * actions)

    def get_observations(self) -> None:
        """Write the observations to `obs_buf`."""
        data = self.robot.data
        velocity, x_axis, y_axis, z_axis = self._in_torso_frame(data.root_quat_w, data.root_lin_vel_w)
        ahead_x, ahead_y, up = x_axis[:, 0], y_axis[:, 0], z_axis[:, 2]  # from the torso's x axis in the world frame

        to_target = self.target - data.root_pos_w[:, :2]
        torch.linalg.vector_norm(to_target, dim=1, out=self.distance)
        x, y = to_target.unbind(dim=1)
        along = torch.addcmul(ahead_x * x, ahead_y, y)
        across = torch.addcmul(ahead_x * y, ahead_y, x, value=-1.0)
        angles = atan2(
            torch.stack([ahead_y, z_axis[:, 1], across], dim=1),  # yaw, roll, target
            torch.stack([ahead_x, up, along], dim=1),
        )
        # before the first physics step of an episode, sensor values belong to the state before the reset: write 0
        felt = (self.progress_buf > 0).mul(self.force_scale)
        torch.cat(
            [
                data.root_pos_w[:, 2:],
                velocity,
                data.root_ang_vel_b * self.rate_scale,
                angles,
                up[:, None],
                (along / self.distance)[:, None],
                torch.addcmul(self.position_offset, self.position_scale, data.joint_pos),
                data.joint_vel * self.joint_vel_scale,
                data.sensordata * felt[:, None],
                self.actions,
            ],
            dim=1,
            out=self.obs_buf,
        )

    def in_terms(self) -> dict[str, list[dict[str, Any]]]:
        """Return the observations and actions as terms of a manager-based task, by section.

        rlcli uses them where it needs terms, for example to export the policy for a robot.
        """
        target = (*self.params.target, 0.0)
        scale = dict(zip(self.joints, self.efforts(), strict=True))
        return {
            "observations": [
                {"func": "base_pos_z"},
                {"func": "base_lin_vel"},
                {"func": "base_ang_vel", "scale": self.rate_scale},
                {"func": "base_yaw_roll"},
                {"func": "base_angle_to_target", "target": target},
                {"func": "base_up_proj"},
                {"func": "base_heading_proj", "target": target},
                {"func": "joint_pos_limit_normalized"},
                {"func": "joint_vel", "scale": self.joint_vel_scale},
                {"func": "sensor_data", "sensors": ".*", "scale": self.force_scale},
                {"func": "last_action"},
            ],
            "actions": [{"func": "joint_effort", "joints": list(self.joints), "scale": scale}],
        }

    def calculate_metrics(self) -> None:
        """Reward progress, posture and survival, minus costs; for a fall the reward is `death_reward` alone."""
        params, obs, actions = self.params, self.obs_buf, self.actions
        cost = (actions * obs[:, self.joint_vel]).abs_().mul_(self.energy_cost)
        cost.addcmul_(actions, actions, value=params.action_cost)
        cost.add_(self.at_limits(obs[:, self.joint_pos]), alpha=params.limit_cost)
        reward = (obs[:, HEADING] / 0.8).clamp_(max=1.0).mul_(params.heading_weight)
        reward.add_(obs[:, UP] > 0.93, alpha=params.up_weight)
        self._measure_speed()
        reward.add_(self.speed, alpha=params.progress_weight)
        reward.add_(params.alive_weight).sub_(cost.sum(dim=1))
        self.rew_buf.copy_(reward.masked_fill_(self._fallen(), params.death_reward))

    def is_done(self) -> None:
        """Terminate where the torso is too low. The environment adds time-outs."""
        self.reset_buf.copy_(self._fallen())

    def _measure_speed(self) -> None:
        """Compute `speed`, the speed towards the target, from the decrease of the distance in the last step.

        |a| - |b| = (a - b) (a + b) / (|a| + |b|), where a - b is the movement in the step. A float32 distance of 1000 m
        is exact to 0.06 mm only, which is 4 mm/s at 60 Hz.
        """
        position = self.robot.data.root_pos_w[:, :2]
        way = position - self.position_before
        both = torch.add(way, self.target - position, alpha=2.0)
        torch.sum(way.mul_(both), dim=1, out=self.speed)
        self.speed.div_((self.distance + self.distance_before).mul_(self.step_dt))
        self.position_before.copy_(position)
        self.distance_before.copy_(self.distance)

    def _in_torso_frame(self, quat: Tensor, velocity: Tensor) -> tuple[Tensor, ...]:
        """Return the torso's velocity and the world's x, y and z axes, all in the torso's frame. (num_envs, 3) each"""
        self.seen[:, 0].copy_(velocity)
        w, axis = quat[:, None, :1], quat[:, None, 1:]
        turned = torch.linalg.cross(axis, self.seen)
        change = torch.linalg.cross(axis, turned).addcmul_(w, turned, value=-1.0)
        return torch.add(self.seen, change, alpha=2.0).unbind(dim=1)

    def _fallen(self) -> Tensor:
        return self.obs_buf[:, HEIGHT] < self.params.termination_height
