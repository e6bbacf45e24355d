"""Ingenuity in the direct workflow: fly from point to point on Mars, with two rotors that push along and sideways.

The hooks are written for a GPU as much as for a CPU: no value is read back, no environment is picked by an index, and
what outlives a step is written in place.
"""

from __future__ import annotations

import math

import torch
from pydantic import Field
from torch import Tensor

from rlcli.config.schema import StrictModel
from rlcli.envs.direct import DirectTask
from rlcli.sim.rotations import length
from rlcli.sim.selection import Selection

ROTORS = ("lower", "upper")


class IngenuityTask(DirectTask):
    """Hover at the target, which jumps. Observations: docs/zoo/ingenuity.md lists the 13 columns."""

    num_observations = 13
    num_actions = 6
    observation_names = (
        *("to_target_x", "to_target_y", "to_target_z", "quat_w", "quat_x", "quat_y", "quat_z"),
        *("vel_x", "vel_y", "vel_z", "rate_x", "rate_y", "rate_z"),
    )
    observation_units = (*("3 m",) * 3, *("",) * 4, *("2 m/s",) * 3, *("pi rad/s",) * 3)
    action_names = tuple(f"{rotor}_{part}" for rotor in ROTORS for part in ("x", "y", "thrust"))
    motors = False

    class Params(StrictModel):
        """The task's own settings."""

        max_thrust: float = Field(20.0, gt=0, description="Largest thrust of a rotor, either way [N].")
        lateral: float = Field(0.2, ge=0, description="Largest share of the thrust along each of x and y.")
        target_period: int = Field(500, gt=0, description="Steps from one target to the next.")
        target_low: tuple[float, float, float] = Field(
            (-1.0, -1.0, 1.0), description="Targets: lower corner of the box they are drawn from [m]."
        )
        target_high: tuple[float, float, float] = Field((1.0, 1.0, 2.0), description="Targets: upper corner [m].")
        start_offset: float = Field(0.5, ge=0, description="Start: offset from the default position +- [m].")
        max_distance: float = Field(20.0, gt=0, description="Distance to the target beyond which it fails [m].")
        min_height: float = Field(0.5, description="Height below which it fails [m].")

    params: Params

    def post_reset(self) -> None:
        """Make what the hooks use: constants, and buffers that keep their place."""
        params, n = self.params, self.num_envs
        self.robot, self.goal = self.env.entities["robot"], self.env.entities["target"]
        self.target_low = torch.tensor(params.target_low, device=self.device)
        self.target_high = torch.tensor(params.target_high, device=self.device)
        phases = -(-self.max_episode_length // params.target_period)
        self.targets = torch.zeros(n, phases, 3, device=self.device)
        """Those of the running episode, in turn. (n, phases, 3) [m]"""
        self.target = torch.zeros(n, 3, device=self.device)
        """The present one. (n, 3) [m]"""
        self.forces = torch.zeros(n, len(ROTORS), 3, device=self.device)
        """Of each rotor, in its own frame. (n, 2, 3) [N]"""
        self.distance = torch.zeros(n, device=self.device)
        self.extras["distance"] = self.distance  # to the target [m]

    def reset(self, selection: Selection) -> None:
        """Level and at rest; the episode's targets are drawn."""
        offset, phases = self.params.start_offset, self.targets.shape[1]
        default = selection.peek(self.robot.data.default_root_state)
        self.robot.write_root_pose(
            selection, default[:, :3] + selection.uniform(-offset, offset, (3,)), default[:, 3:7]
        )
        targets = selection.uniform(self.target_low, self.target_high, (phases, 3))
        selection.write(self.targets, targets)
        selection.write(self.target, targets[:, 0])
        self.goal.write_root_pose(selection, targets[:, 0], selection.read(self.goal.data.default_root_state[:, 3:7]))

    def pre_physics_step(self, actions: Tensor) -> None:
        """Of each rotor: two sideways shares of its thrust, and the thrust."""
        phase = (self.progress_buf // self.params.target_period).clamp_(max=self.targets.shape[1] - 1)
        self.target.copy_(self.targets.gather(1, phase[:, None, None].expand(-1, 1, 3)).squeeze(1))
        self.env.engine.field("mocap_pos")[:, self.goal.mocap].copy_(self.target)
        asked = actions.view(-1, len(ROTORS), 3).clamp(-1.0, 1.0)
        thrust = asked[..., 2:] * self.params.max_thrust
        torch.mul(asked[..., :2], thrust * self.params.lateral, out=self.forces[..., :2])
        self.forces[..., 2:].copy_(thrust)
        self.env.engine.field("ctrl").copy_(self.forces.view(-1, 6))

    def get_observations(self) -> None:
        """Fill obs_buf."""
        data = self.robot.data
        torch.cat(
            [
                (self.target - data.root_pos_w).div_(3.0),
                data.root_quat_w,
                data.root_lin_vel_w * 0.5,
                data.root_ang_vel_w / math.pi,
            ],
            dim=1,
            out=self.obs_buf,
        )

    def calculate_metrics(self) -> None:
        """Nearness; and near the target, uprightness and not to spin."""
        data = self.robot.data
        self.distance.copy_(length(self.target - data.root_pos_w))
        _, x, y, _ = data.root_quat_w.unbind(dim=1)
        tilt = 2.0 * torch.addcmul(x * x, y, y)  # 1 - cos of the angle between up and the vertical
        spin = data.root_ang_vel_w[:, 2]
        near = 1.0 / (1.0 + 2.5 * self.distance.square())
        posture = 1.0 / (1.0 + 30.0 * tilt.square()) + 1.0 / (1.0 + 10.0 * spin.square())
        self.rew_buf.copy_(near + near * posture)

    def is_done(self) -> None:
        """Too far or too low; the framework adds the time-out."""
        low = self.robot.data.root_pos_w[:, 2] < self.params.min_height
        self.reset_buf.copy_((self.distance > self.params.max_distance) | low)
