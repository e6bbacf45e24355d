"""Ant in the direct workflow: a four-legged walker runs towards a far target.

The hooks are written for a GPU as much as for a CPU: no value is read back, no environment is picked by an index, what
outlives a step is written in place, and tensors are few.
"""

from __future__ import annotations

from typing import Any

import torch
from pydantic import Field
from torch import Tensor

from rlcli.config.schema import StrictModel
from rlcli.envs.articulation import ArticulationView
from rlcli.envs.direct import DirectTask
from rlcli.sim.rotations import atan2
from rlcli.sim.selection import Selection

LEGS = ("fl", "bl", "br", "fr")
JOINTS = tuple(f"{joint}_{leg}" for leg in LEGS for joint in ("hip", "ankle"))
_WRENCH = ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z")

HEIGHT, UP, HEADING = 0, 10, 11
JOINT_POS, JOINT_VEL = slice(12, 20), slice(20, 28)
"""Columns of the observation that rewards and terminations read."""


class AntTask(DirectTask):
    """Run towards the target. Observations: docs/zoo/ant-direct.md lists the 60 columns."""

    num_observations = 60
    num_actions = 8
    observation_names = (
        *("height", "vel_x", "vel_y", "vel_z", "rate_x", "rate_y", "rate_z", "yaw", "roll", "target_angle"),
        *("up", "heading"),
        *(f"{joint}_pos" for joint in JOINTS),
        *(f"{joint}_vel" for joint in JOINTS),
        *(f"{leg}_{part}" for leg in LEGS for part in _WRENCH),
        *(f"{joint}_action" for joint in JOINTS),
    )
    observation_units = (
        *("m", "m/s", "m/s", "m/s", "rad/s", "rad/s", "rad/s", "rad", "rad", "rad", "", ""),
        *("half range",) * 8,
        *("5 rad/s",) * 8,
        *(("10 N",) * 3 + ("10 N m",) * 3) * 4,
        *("",) * 8,
    )
    action_names = JOINTS

    class Params(StrictModel):
        """The task's own settings."""

        effort: float = Field(7.5, gt=0, description="Torque at action 1 [N m].")
        target: tuple[float, float] = Field((1000.0, 0.0), description="Where to run, x and y [m].")
        termination_height: float = Field(0.31, description="Torso height below which the episode fails [m].")
        death_reward: float = Field(-2.0, description="Reward of the step that fails, in place of all others.")
        alive_weight: float = Field(0.5, description="Reward a step.")
        progress_weight: float = Field(1.0, description="Reward on the speed towards the target [s/m].")
        up_weight: float = Field(0.1, description="Reward where the torso is upright to within acos(0.93).")
        heading_weight: float = Field(0.5, description="Reward where the torso faces the target, to within acos(0.8).")
        action_cost: float = Field(0.005, ge=0, description="Penalty on squared actions.")
        energy_cost: float = Field(0.05, ge=0, description="Penalty on |action x joint velocity / (5 rad/s)|.")
        limit_cost: float = Field(
            0.1, ge=0, description="Penalty on each joint within 1% of its half range of a limit."
        )
        joint_pos_noise: float = Field(0.2, ge=0, description="Start: joint positions +-, inside the limits [rad].")
        joint_vel_noise: float = Field(0.1, ge=0, description="Start: joint velocities +- [rad/s].")

    params: Params

    def set_up_scene(self, scene) -> None:
        """Register the view of the robots."""
        self.ants = scene.add(ArticulationView("robot", name="ant_view"))

    def post_reset(self) -> None:
        """Make what the hooks use: constants, and buffers that keep their place."""
        self.robot = self.env.entities["robot"]
        data, params, n = self.robot.data, self.params, self.num_envs
        low, high = data.joint_pos_limits.to(self.device).unbind(dim=1)
        self.position_scale = 2.0 / (high - low)
        self.position_offset = (low + high) / (low - high)
        default = data.default_joint_pos[0]
        self.start_low = torch.maximum(default - params.joint_pos_noise, low)
        self.start_high = torch.minimum(default + params.joint_pos_noise, high)
        self.target = torch.tensor(params.target, device=self.device)
        self.start_distance = torch.linalg.vector_norm(self.target - data.default_root_state[:, :2], dim=1)
        self.distance = self.start_distance.clone()
        self.distance_before = self.start_distance.clone()
        self.speed = torch.zeros(n, device=self.device)
        self.extras["speed"] = self.speed  # towards the target [m/s]
        self.actions = torch.zeros(n, self.num_actions, device=self.device)
        # the velocity of the torso and the three axes of the world, all to be seen from the torso
        self.seen = torch.cat([torch.zeros(1, 3), torch.eye(3)]).to(self.device).repeat(n, 1, 1)

    def reset(self, selection: Selection) -> None:
        """Joints about their default, the torso where the scene puts it, at rest."""
        noise = self.params.joint_vel_noise
        shape = (self.num_actions,)
        self.robot.write_joint_positions(selection, selection.uniform(self.start_low, self.start_high, shape))
        self.robot.write_joint_velocities(selection, selection.uniform(-noise, noise, shape))
        selection.write(self.distance_before, selection.read(self.start_distance))
        selection.write(self.actions, 0.0)

    def pre_physics_step(self, actions: Tensor) -> None:
        """Torques on hips and ankles."""
        self.actions.copy_(actions)
        self.ants.set_joint_efforts(self.params.effort * actions)

    def get_observations(self) -> None:
        """Fill obs_buf."""
        data = self.robot.data
        velocity, x_axis, y_axis, z_axis = self._from_the_torso(data.root_quat_w, data.root_lin_vel_w)
        ahead_x, ahead_y, up = x_axis[:, 0], y_axis[:, 0], z_axis[:, 2]  # the torso's x axis, in the world

        to_target = self.target - data.root_pos_w[:, :2]
        torch.linalg.vector_norm(to_target, dim=1, out=self.distance)
        x, y = to_target.unbind(dim=1)
        along = torch.addcmul(ahead_x * x, ahead_y, y)
        across = torch.addcmul(ahead_x * y, ahead_y, x, value=-1.0)
        angles = atan2(
            torch.stack([ahead_y, z_axis[:, 1], across], dim=1),  # yaw, roll, target
            torch.stack([ahead_x, up, along], dim=1),
        )
        # a new episode has had no physics step: what the sensors show is not of its state
        felt = (self.progress_buf > 0).mul(0.1)
        torch.cat(
            [
                data.root_pos_w[:, 2:],
                velocity,
                data.root_ang_vel_b,
                angles,
                up[:, None],
                (along / self.distance)[:, None],
                torch.addcmul(self.position_offset, self.position_scale, data.joint_pos),
                data.joint_vel * 0.2,
                data.sensordata * felt[:, None],
                self.actions,
            ],
            dim=1,
            out=self.obs_buf,
        )

    def in_terms(self) -> dict[str, list[dict[str, Any]]]:
        """The same in the vocabulary of manager-based tasks."""
        target = (*self.params.target, 0.0)
        return {
            "observations": [
                {"func": "base_pos_z"},
                {"func": "base_lin_vel"},
                {"func": "base_ang_vel"},
                {"func": "base_yaw_roll"},
                {"func": "base_angle_to_target", "target": target},
                {"func": "base_up_proj"},
                {"func": "base_heading_proj", "target": target},
                {"func": "joint_pos_limit_normalized"},
                {"func": "joint_vel", "scale": 0.2},
                {"func": "sensor_data", "sensors": ".*", "scale": 0.1},
                {"func": "last_action"},
            ],
            "actions": [{"func": "joint_effort", "joints": list(JOINTS), "scale": self.params.effort}],
        }

    def calculate_metrics(self) -> None:
        """Progress, posture and life, less what they cost; a fall costs the rest."""
        params, obs, actions = self.params, self.obs_buf, self.actions
        cost = (actions * obs[:, JOINT_VEL]).abs_().mul_(params.energy_cost)
        cost.addcmul_(actions, actions, value=params.action_cost)
        cost.add_(obs[:, JOINT_POS].abs() > 0.99, alpha=params.limit_cost)
        reward = (obs[:, HEADING] / 0.8).clamp_(max=1.0).mul_(params.heading_weight)
        reward.add_(obs[:, UP] > 0.93, alpha=params.up_weight)
        torch.sub(self.distance_before, self.distance, out=self.speed).div_(self.step_dt)
        reward.add_(self.speed, alpha=params.progress_weight)
        reward.add_(params.alive_weight).sub_(cost.sum(dim=1))
        self.rew_buf.copy_(reward.masked_fill_(self._fallen(), params.death_reward))
        self.distance_before.copy_(self.distance)

    def is_done(self) -> None:
        """The torso is too low; the framework adds the time-out."""
        self.reset_buf.copy_(self._fallen())

    def _from_the_torso(self, quat: Tensor, velocity: Tensor) -> tuple[Tensor, ...]:
        """The torso's velocity and the world's axes in the torso's frame, four rotations as one. (n, 3) each"""
        self.seen[:, 0].copy_(velocity)
        w, axis = quat[:, None, :1], quat[:, None, 1:]
        turned = torch.linalg.cross(axis, self.seen)
        change = torch.linalg.cross(axis, turned).addcmul_(w, turned, value=-1.0)
        return torch.add(self.seen, change, alpha=2.0).unbind(dim=1)

    def _fallen(self) -> Tensor:
        return self.obs_buf[:, HEIGHT] < self.params.termination_height
