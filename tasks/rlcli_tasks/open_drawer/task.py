"""Open drawer in the direct workflow: an arm grasps the handle of a drawer and pulls.

The methods of the class can also run as a CUDA graph on a GPU: they read no value back, select environments by masks
instead of indices, write tensors that are kept between steps in place, and create few tensors.
"""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor

from rlcli.config.schema import StrictModel
from rlcli.envs.articulation import ArticulationView
from rlcli.envs.direct import DirectTask
from rlcli.sim.env_selection import Selection
from rlcli.sim.rotations import axis_y, axis_z, length

JOINTS = (*(f"joint{i}" for i in range(1, 8)), "finger_left", "finger_right")
FINGERS = slice(7, 9)
"""Columns of the fingers in joint positions and in the action."""
WAY, OPENING, OPENING_RATE = slice(18, 21), 21, 22
"""Columns of the observation: vector from the grasp point to the handle, opening of the drawer, and its rate."""
FULLY_OPEN = 0.04
"""Position of a finger when the gripper is fully open [m]."""


class DrawerTask(DirectTask):
    """Pull the drawer open. Observations: docs/reference/zoo/open-drawer.md lists the 23 columns."""

    num_observations = 23
    num_actions = 9
    observation_names = (
        *(f"{joint}_pos" for joint in JOINTS),
        *(f"{joint}_vel" for joint in JOINTS),
        *("to_handle_x", "to_handle_y", "to_handle_z", "drawer_pos", "drawer_vel"),
    )
    observation_units = (
        *("half range",) * 9,
        *("10 rad/s",) * 7,
        *("10 m/s",) * 2,
        *("m", "m", "m", "m", "m/s"),
    )
    action_names = JOINTS
    motors = False  # the drawer has no motor

    class Params(StrictModel):
        """Parameters of the task, set in the section `params:` of its YAML."""

        action_scale: float = Field(2.5, gt=0, description="Speed of the target of an arm joint at action 1 [rad/s].")
        finger_speed: float = Field(
            0.1, gt=0, description="Speed of a finger's target [m/s] at action 1, divided by action_scale [m/rad]."
        )
        velocity_scale: float = Field(
            0.1, gt=0, description="Factor on the observed velocities of joints [s/rad] and fingers [s/m]."
        )
        start_noise: float = Field(
            0.125,
            ge=0,
            description=(
                "Largest absolute initial offset of a joint [rad] or finger [m] from its default position, "
                "within the joint limits."
            ),
        )
        start_opening: float = Field(0.01, ge=0, description="Largest initial opening of the drawer [m].")
        distance_weight: float = Field(
            2.0, description="Weight of the nearness of the grasp point to the handle, a value from 0 to 2."
        )
        rotation_weight: float = Field(
            0.5, description="Weight of the alignment of the gripper with the handle, a value from -1 to 1."
        )
        around_weight: float = Field(
            10.0,
            description=(
                "Weight of a grasp, a value of 0.5 if one finger is above and one below the handle within "
                "`reach`, else 0."
            ),
        )
        finger_weight: float = Field(
            100.0,
            description=(
                "Weight of the nearness of the fingers' heights to the handle's height during a grasp: 0.08 m "
                "minus the sum of both height differences [1/m]."
            ),
        )
        close_weight: float = Field(
            10.0,
            description=(
                "Weight of how far the fingers are closed, if the grasp point is within 3 cm of the handle [1/m]."
            ),
        )
        open_weight: float = Field(
            7.5, description="Weight of the drawer's opening; 1.5 times this weight during a grasp [1/m]."
        )
        reach: float = Field(
            0.05,
            gt=0,
            description=(
                "Largest distance of the grasp point from the handle at which the fingers can count as a grasp [m]."
            ),
        )
        action_cost: float = Field(0.01, ge=0, description="Weight of the penalty on the sum of squared actions.")

    params: Params

    def set_up_scene(self, scene) -> None:
        """Register a view of the arms: their state in all environments, as tensors."""
        self.arms = scene.add(ArticulationView("robot", name="arm_view"))

    def post_reset(self) -> None:
        """Create constants, and buffers that the other methods write in place."""
        self.robot, self.cabinet = self.env.entities["robot"], self.env.entities["cabinet"]
        data, params, n = self.robot.data, self.params, self.num_envs
        self.low, self.high = data.joint_pos_limits.to(self.device).unbind(dim=1)
        self.position_scale = 2.0 / (self.high - self.low)
        self.position_offset = (self.low + self.high) / (self.low - self.high)
        default = data.default_joint_pos[0]
        self.start_low = torch.maximum(default - params.start_noise, self.low)
        self.start_high = torch.minimum(default + params.start_noise, self.high)
        share = torch.ones(self.num_actions)
        share[FINGERS] = params.finger_speed
        self.stride = (params.action_scale * self.step_dt * share).to(self.device)
        """Change of each position target in one environment step at action 1. (9,)"""
        self.targets = data.default_joint_pos.clone()
        self.actions = torch.zeros(n, self.num_actions, device=self.device)
        self.opening = torch.zeros(n, device=self.device)
        self.extras["opening"] = self.opening  # opening of the drawer [m]
        names = self.robot.names
        self.hand = names["Bodies"].index("hand")
        self.left, self.right = (names["Bodies"].index(f"finger_{side}") for side in ("left", "right"))
        self.grasp = names["Sites"].index("grasp")
        self.handle = self.cabinet.names["Sites"].index("handle")

    def reset(self, selection: Selection) -> None:
        """Put the arm near its default pose and the drawer nearly shut, all at rest."""
        position = selection.uniform(self.start_low, self.start_high, (self.num_actions,))
        self.robot.write_joint_positions(selection, position)
        self.cabinet.write_joint_positions(selection, selection.uniform(0.0, self.params.start_opening, (1,)))
        selection.write(self.targets, position)
        selection.write(self.actions, 0.0)

    def pre_physics_step(self, actions: Tensor) -> None:
        """Move the position targets of the joints by the actions, which are speeds, within the joint limits."""
        self.actions.copy_(actions)
        self.targets.addcmul_(self.stride, actions)
        torch.minimum(torch.maximum(self.targets, self.low, out=self.targets), self.high, out=self.targets)
        self.arms.set_joint_position_targets(self.targets)

    def get_observations(self) -> None:
        """Write the observations to `obs_buf`."""
        arm, drawer = self.robot.data, self.cabinet.data
        torch.cat(
            [
                torch.addcmul(self.position_offset, self.position_scale, arm.joint_pos),
                arm.joint_vel * self.params.velocity_scale,
                drawer.site_pos_w[:, self.handle] - arm.site_pos_w[:, self.grasp],
                drawer.joint_pos,
                drawer.joint_vel,
            ],
            dim=1,
            out=self.obs_buf,
        )

    def calculate_metrics(self) -> None:
        """Reward nearness, orientation, grasp and opening, minus a penalty on actions."""
        params, arm = self.params, self.robot.data
        self.opening.copy_(self.obs_buf[:, OPENING])
        opening, distance = self.opening, length(self.obs_buf[:, WAY])
        near = (1.0 / (1.0 + distance * distance)).square_()
        near.mul_(1.0 + (distance <= 0.02))

        quat = arm.body_quat_w[:, self.hand]
        ahead, up = -axis_z(quat)[:, 0], axis_y(quat)[:, 2]
        aligned = 0.5 * (ahead * ahead.abs() + up * up.abs())

        height = self.cabinet.data.site_pos_w[:, self.handle, 2]
        above = arm.body_pos_w[:, self.left, 2] - height
        below = height - arm.body_pos_w[:, self.right, 2]
        around = ((above > 0.0) & (below > 0.0) & (distance <= params.reach)).float()
        fingers = around * (2.0 * FULLY_OPEN - above - below)
        closed = (distance <= 0.03) * (FULLY_OPEN - arm.joint_pos[:, FINGERS]).sum(dim=1)
        around.mul_(0.5)

        reward = params.distance_weight * near
        reward.add_(aligned, alpha=params.rotation_weight).add_(around, alpha=params.around_weight)
        reward.add_(fingers, alpha=params.finger_weight).add_(closed, alpha=params.close_weight)
        reward.addcmul_(opening, 1.0 + around, value=params.open_weight)
        reward.add_(self.actions.square().sum(dim=1), alpha=-params.action_cost)
        reward.add_(opening > 0.01, alpha=0.5)
        reward.addcmul_(opening > 0.2, around).addcmul_(opening > 0.39, around, value=2.0)
        self.rew_buf.copy_(reward)

    def is_done(self) -> None:
        """Never terminate: episodes only end by time-out, because the drawer must be held open."""
        self.reset_buf.zero_()
