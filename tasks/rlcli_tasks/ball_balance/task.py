"""Ball balance in the direct workflow: a table on three legs catches a ball and holds it in the middle.

The methods of the class can also run as a CUDA graph on a GPU: they read no value back, select environments by masks
instead of indices, and write tensors that are kept between steps in place.
"""

from __future__ import annotations

import math

import torch
from pydantic import Field
from torch import Tensor

from rlcli.config.schema import StrictModel
from rlcli.envs.articulation import ArticulationView
from rlcli.envs.direct import DirectTask
from rlcli.sim.env_selection import Selection

LEGS = (0, 1, 2)
KNEES = tuple(f"knee{leg}" for leg in LEGS)
JOINTS = tuple(f"{joint}{leg}" for leg in LEGS for joint in ("hip", "knee"))

BALL_POS, BALL_VEL = slice(6, 9), slice(9, 12)
"""Columns of the ball's position [m] and velocity [m/s] in the observation; rewards and terminations read them."""


class BallBalanceTask(DirectTask):
    """Hold the ball in the middle. Observations: docs/reference/zoo/ball-balance.md lists the 24 columns."""

    num_observations = 24
    num_actions = 3
    motors = False
    observation_names = (
        *(f"{knee}_pos" for knee in KNEES),
        *(f"{knee}_vel" for knee in KNEES),
        *("ball_x", "ball_y", "ball_z", "ball_vel_x", "ball_vel_y", "ball_vel_z"),
        *(f"leg{leg}_force_x" for leg in LEGS),
        *(f"leg{leg}_torque_{axis}" for axis in "xyz" for leg in LEGS),
    )
    observation_units = (
        *("rad",) * 3,
        *("rad/s",) * 3,
        *("m",) * 3,
        *("m/s",) * 3,
        *("20 N",) * 3,
        *("20 N m",) * 9,
    )
    action_names = KNEES

    class Params(StrictModel):
        """Parameters of the task, set in the section `params:` of its YAML."""

        speed: float = Field(20.0, gt=0, description="Speed of the target angle of a knee at action 1 [rad/s].")
        target_height: float = Field(0.7, description="Height of the point where the ball should rest [m].")
        fall_height: float = Field(0.15, description="An episode fails if the ball is lower than this [m].")
        start_distance: tuple[float, float] = Field(
            (0.001, 0.4),
            description="Range of the ball's initial horizontal distance from the middle: lowest, highest [m].",
        )
        start_height: tuple[float, float] = Field(
            (1.0, 2.0), description="Range of the ball's initial height: lowest, highest [m]."
        )
        start_speed: float = Field(
            2.0,
            ge=0,
            description=(
                "Highest initial speed of the ball towards the middle, if the ball starts at the largest "
                "distance; proportionally less at smaller distances [m/s]."
            ),
        )
        start_drop: float = Field(5.0, ge=0, description="Initial downward speed of the ball [m/s].")

    params: Params

    def set_up_scene(self, scene) -> None:
        """Register a view of the tables: their state in all environments, as tensors."""
        self.tables = scene.add(ArticulationView("robot", name="table_view"))

    def post_reset(self) -> None:
        """Create constants, and buffers that the other methods write in place."""
        self.robot, self.ball = self.env.entities["robot"], self.env.entities["ball"]
        assert tuple(self.robot.joint_names) == JOINTS
        params, device = self.params, self.device
        low, high = self.robot.data.joint_pos_limits.to(device).unbind(dim=1)
        self.lowest, self.highest = low[1::2].contiguous(), high[1::2].contiguous()
        self.targets = torch.zeros(self.num_envs, len(JOINTS), device=device)  # knees [rad]; hips have no motor
        self.goal = torch.tensor([0.0, 0.0, params.target_height], device=device)
        # ranges of the initial state: distance, direction, height, and inward speed as a fraction of the highest
        ranges = [params.start_distance, (-math.pi, math.pi), params.start_height, (0.0, 1.0)]
        self.start_low, self.start_high = torch.tensor(ranges, device=device).unbind(dim=1)
        self.distance = torch.zeros(self.num_envs, device=device)
        self.extras["distance"] = self.distance  # distance of the ball from its goal [m]

    def reset(self, selection: Selection) -> None:
        """Put the table at rest, and the ball above it: falling, and moving towards the middle.

        The farther the ball is from the middle, the faster it may move.
        """
        params = self.params
        distance, direction, height, share = selection.uniform(self.start_low, self.start_high, (4,)).unbind(dim=1)
        nearest, furthest = params.start_distance
        speed = share * (distance - nearest) * (params.start_speed / max(furthest - nearest, 1e-9))
        x, y, zero = direction.cos(), direction.sin(), torch.zeros_like(distance)
        upright = torch.stack([zero + 1.0, zero, zero, zero], dim=1)
        self.ball.write_root_pose(selection, torch.stack([distance * x, distance * y, height], dim=1), upright)
        velocity = torch.stack([-speed * x, -speed * y, zero - params.start_drop], dim=1)
        self.ball.write_root_velocity(selection, velocity, torch.zeros_like(velocity))
        selection.write(self.targets, 0.0)

    def pre_physics_step(self, actions: Tensor) -> None:
        """Move the position targets of the knees by the actions, which are speeds, within the joint limits."""
        knees = self.targets[:, 1::2]
        knees.add_(actions, alpha=self.params.speed * self.step_dt)
        knees.copy_(torch.minimum(torch.maximum(knees, self.lowest), self.highest))
        self.tables.set_joint_position_targets(self.targets)

    def get_observations(self) -> None:
        """Write the observations to `obs_buf`."""
        robot, ball = self.robot.data, self.ball.data
        # before the first physics step of an episode, sensor values belong to the state before the reset: write 0
        scale = (self.progress_buf > 0).mul(1.0 / 20.0)
        readings = robot.sensordata.unflatten(1, (len(LEGS), 6)).transpose(1, 2) * scale[:, None, None]
        torch.cat(
            [
                robot.joint_pos[:, 1::2],
                robot.joint_vel[:, 1::2],
                ball.root_pos_w,
                ball.root_lin_vel_w,
                readings[:, 0],
                readings[:, 3:].flatten(1),
            ],
            dim=1,
            out=self.obs_buf,
        )

    def calculate_metrics(self) -> None:
        """Reward a ball that is slow and near the middle; at rest in the middle the reward is 1."""
        speed = torch.linalg.vector_norm(self.obs_buf[:, BALL_VEL], dim=1)
        torch.linalg.vector_norm(self.obs_buf[:, BALL_POS] - self.goal, dim=1, out=self.distance)
        self.rew_buf.copy_(((1.0 + self.distance) * (1.0 + speed)).reciprocal_())

    def is_done(self) -> None:
        """Terminate where the ball has fallen off the table. The environment adds time-outs."""
        self.reset_buf.copy_(self.obs_buf[:, BALL_POS][:, 2] < self.params.fall_height)
