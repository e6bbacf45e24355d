"""Hand in the direct workflow: fingers turn a cube to one orientation after another.

The methods of the class can also run as a CUDA graph on a GPU: they read no value back, select environments by masks
instead of indices, and write tensors that are kept between steps in place.
"""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor

from rlcli.config.schema import StrictModel
from rlcli.envs.articulation import ArticulationView
from rlcli.envs.direct import DirectTask
from rlcli.sim.env_selection import Selection
from rlcli.sim.rotations import conjugate, length, multiply, random_quaternion, turn_between, unique

FINGERS = ("index", "middle", "ring", "thumb")
JOINTS = tuple(f"{finger}_{joint}" for finger in FINGERS for joint in range(4))
_QUAT, _XYZ = ("w", "x", "y", "z"), ("x", "y", "z")
GOAL = slice(45, 53)
"""Columns of the observation that change with the goal: its orientation, and the rotation from it to the cube."""


class HandTask(DirectTask):
    """Turn the cube to one goal after another. Observations: docs/reference/zoo/hand-reorient.md lists the 69 columns.

    The critic observes 145 columns: these 69, then poses, velocities, forces and torques of the fingertips.
    """

    num_observations = 69
    num_actions = 16
    num_states = 145
    observation_names = (
        *(f"{joint}_pos" for joint in JOINTS),
        *(f"{joint}_vel" for joint in JOINTS),
        *(f"cube_{axis}" for axis in _XYZ),
        *(f"cube_quat_{axis}" for axis in _QUAT),
        *(f"cube_vel_{axis}" for axis in _XYZ),
        *(f"cube_rate_{axis}" for axis in _XYZ),
        *(f"goal_quat_{axis}" for axis in _QUAT),
        *(f"turn_quat_{axis}" for axis in _QUAT),
        *(f"{joint}_action" for joint in JOINTS),
    )
    observation_units = (
        *("half range",) * 16,
        *("5 rad/s",) * 16,
        *("m",) * 3,
        *("",) * 4,
        *("m/s",) * 3,
        *("5 rad/s",) * 3,
        *("",) * 24,
    )
    action_names = JOINTS
    motors = False

    class Params(StrictModel):
        """Parameters of the task, set in the section `params:` of its YAML."""

        goal_pos: tuple[float, float, float] = Field(
            (-0.01, 0.0, 0.55), description="Position where the cube should stay: x, y, z [m]."
        )
        shown_pos: tuple[float, float, float] = Field(
            (0.12, 0.2, 0.62), description="Position where viewers display the goal orientation: x, y, z [m]."
        )
        smoothing: float = Field(
            0.5,
            gt=0,
            le=1,
            description="Weight of the new joint target in each step; the previous target has the rest of the weight.",
        )
        success_tolerance: float = Field(
            0.4, gt=0, description="A goal is reached if the angle between cube and goal is at most this [rad]."
        )
        fall_distance: float = Field(
            0.24, gt=0, description="An episode fails if the cube is this far or farther from goal_pos [m]."
        )
        distance_weight: float = Field(
            -10.0, description="Weight of the cube's distance from goal_pos in the reward; negative: a penalty [1/m]."
        )
        rotation_weight: float = Field(
            1.0, description="Weight of 1 / (angle to the goal + rotation_eps) in the reward [rad]."
        )
        rotation_eps: float = Field(
            0.1, gt=0, description="Angle that is added to the angle to the goal in the term of rotation_weight [rad]."
        )
        action_weight: float = Field(
            -0.0002, description="Weight of the sum of squared actions in the reward; negative: a penalty."
        )
        goal_bonus: float = Field(250.0, description="Additional reward of a step in which a goal is reached.")
        fall_reward: float = Field(
            0.0, description="Additional reward of the step in which the episode fails; negative: a penalty."
        )
        position_noise: float = Field(
            0.01,
            ge=0,
            description="Largest absolute initial offset of the cube from its default position, along each axis [m].",
        )
        joint_noise: float = Field(
            0.2,
            ge=0,
            le=1,
            description=(
                "Initial joint positions are moved by this fraction of the way from the default to a position "
                "sampled within the joint limits."
            ),
        )

    params: Params

    def set_up_scene(self, scene) -> None:
        """Register a view of the hands: their state in all environments, as tensors."""
        self.hands = scene.add(ArticulationView("robot", name="hand_view"))

    def post_reset(self) -> None:
        """Create constants, and buffers that the other methods write in place."""
        self.robot, self.cube, self.shown = (self.env.entities[name] for name in ("robot", "object", "goal"))
        data, params, n, device = self.robot.data, self.params, self.num_envs, self.device
        self.low, self.high = (ends.clone() for ends in data.joint_pos_limits.to(device).unbind(dim=1))
        self.middle, self.half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        default, noise = data.default_joint_pos[0], params.joint_noise
        self.start_low, self.start_high = (torch.lerp(default, end, noise) for end in (self.low, self.high))
        self.ends = torch.tensor(
            [self.robot.names["Bodies"].index(f"{finger}_distal") for finger in FINGERS], device=device
        )
        self.goal_pos = torch.tensor([params.goal_pos], device=device).repeat(n, 1)
        self.shown_pos = torch.tensor([params.shown_pos], device=device).repeat(n, 1)
        self.goal_quat = torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device).repeat(n, 1)
        self.actions = torch.zeros(n, self.num_actions, device=device)
        self.targets = torch.zeros(n, self.num_actions, device=device)
        self.distance = torch.zeros(n, device=device)
        self.angle = torch.zeros(n, device=device)
        self.successes = torch.zeros(n, device=device)  # goals reached in the current episode
        self.episode_metrics["successes"] = self.successes
        self.extras["angle"] = self.angle  # angle to the goal [rad]

    def reset(self, selection: Selection) -> None:
        """Put the fingers near their default pose and the cube above the palm, randomly oriented; sample a goal."""
        joints = selection.uniform(self.start_low, self.start_high, (self.num_actions,))
        self.robot.write_joint_positions(selection, joints)
        noise = self.params.position_noise
        place = selection.read(self.cube.data.default_root_state[:, :3])
        place += selection.uniform(-noise, noise, (3,))
        self.cube.write_root_pose(selection, place, _random_rotation(selection))
        self._draw_goal(selection)
        selection.write(self.targets, joints)
        selection.write(self.actions, 0.0)
        selection.write(self.successes, 0.0)

    def pre_physics_step(self, actions: Tensor) -> None:
        """Set the position targets of the joints: a weighted mean of the actions and the previous targets."""
        self.actions.copy_(actions)
        wanted = torch.addcmul(self.middle, self.half, actions)
        self.targets.lerp_(wanted, self.params.smoothing)
        torch.clamp(self.targets, self.low, self.high, out=self.targets)
        self.hands.set_joint_position_targets(self.targets)

    def get_observations(self) -> None:
        """Write the observations to `obs_buf`."""
        hand, cube = self.robot.data, self.cube.data
        torch.cat(
            [
                (hand.joint_pos - self.middle) / self.half,
                hand.joint_vel * 0.2,
                cube.root_pos_w,
                unique(cube.root_quat_w),
                cube.root_lin_vel_w,
                cube.root_ang_vel_w * 0.2,
                self._goal(),
                self.actions,
            ],
            dim=1,
            out=self.obs_buf,
        )

    def get_states(self) -> None:
        """Write `states_buf`: the observations, then pose, velocity, and force and torque of each fingertip."""
        position, quat, linear, angular = self.robot.data.body_states_of(self.ends)
        # before the first physics step of an episode, sensor values belong to the state before the reset: write 0
        felt = (self.progress_buf > 0).mul(0.1)
        torch.cat(
            [
                self.obs_buf,
                position.flatten(1),
                quat.flatten(1),
                linear.flatten(1),
                angular.flatten(1) * 0.2,
                self.robot.data.sensordata * felt[:, None],
            ],
            dim=1,
            out=self.states_buf,
        )

    def calculate_metrics(self) -> None:
        """Reward a cube near its position and goal orientation, minus a penalty on actions; add a bonus for a goal.

        Where a goal is reached, sample the next one.
        """
        params, cube = self.params, self.cube.data
        self.distance.copy_(length(cube.root_pos_w - self.goal_pos))
        self.angle.copy_(turn_between(self.goal_quat, cube.root_quat_w))
        reached = self.angle <= params.success_tolerance
        reward = params.rotation_weight / (self.angle + params.rotation_eps)
        reward.add_(self.distance, alpha=params.distance_weight)
        reward.add_(self.actions.square().sum(dim=1), alpha=params.action_weight)
        reward.add_(reached, alpha=params.goal_bonus)
        reward.add_(self.distance >= params.fall_distance, alpha=params.fall_reward)
        self.rew_buf.copy_(reward)
        self.successes.add_(reached)
        due = self.selection(reached, "goal")
        if due is not None:
            self._draw_goal(due)
            self.obs_buf[:, GOAL] = self._goal()  # the next action already uses the new goal
            if self.num_states:
                self.states_buf[:, GOAL] = self.obs_buf[:, GOAL]

    def is_done(self) -> None:
        """Terminate where the cube has fallen. The environment adds time-outs."""
        self.reset_buf.copy_(self.distance >= self.params.fall_distance)

    def _draw_goal(self, selection: Selection) -> None:
        """Sample a goal orientation in the selected environments, and show it in the viewer."""
        quat = _random_rotation(selection)
        selection.write(self.goal_quat, quat)
        self.shown.write_root_pose(selection, selection.read(self.shown_pos), quat)

    def _goal(self) -> Tensor:
        """Return two quaternions: the goal's orientation, and the rotation from it to the cube. (num_envs, 8)"""
        turn = multiply(self.cube.data.root_quat_w, conjugate(self.goal_quat))
        return torch.cat([self.goal_quat, unique(turn)], dim=1)


def _random_rotation(selection: Selection) -> Tensor:
    """Sample rotations uniformly, with w >= 0. (rows, 4)"""
    return unique(random_quaternion(*selection.uniform(0.0, 1.0, (3,)).unbind(1)))
