"""Isaac Lab's terms and which of rlcli's each is; a term that is not named here has the same name in both."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

Translate = Callable[[Any], dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Entry:
    """A term under another name, or with parameters under other names (or computed from theirs)."""

    name: str | None = None
    params: Mapping[str, str | Translate] = field(default_factory=dict)
    note: str | None = None
    """What is not quite the same."""


def _pose(value: Mapping[str, Any]) -> dict[str, Any]:
    return {axis: value[axis] for axis in ("x", "y", "z", "roll", "pitch", "yaw") if axis in value}


def _velocity(value: Mapping[str, Any]) -> dict[str, Any]:
    still = (0.0, 0.0)
    made = {
        "linear_velocity": [value.get(axis, still) for axis in ("x", "y", "z")],
        "angular_velocity": [value.get(axis, still) for axis in ("roll", "pitch", "yaw")],
    }
    return {key: ranges for key, ranges in made.items() if any(tuple(r) != still for r in ranges)}


_JOINTS: dict[str, str | Translate] = {"position_range": "position", "velocity_range": "velocity"}
_ROOT: dict[str, str | Translate] = {"pose_range": _pose, "velocity_range": _velocity}

TERMS: dict[str, dict[str, Entry]] = {
    "observations": {
        "generated_commands": Entry(params={"command_name": "command"}),
    },
    "rewards": {
        "track_lin_vel_xy_exp": Entry(params={"command_name": "command"}),
        "track_ang_vel_z_exp": Entry(params={"command_name": "command"}),
        "move_to_target_bonus": Entry(params={"target_pos": "target"}),
        "progress_reward": Entry(params={"target_pos": "target"}),
    },
    "terminations": {
        "command_resample": Entry(params={"command_name": "command"}),
    },
    "events": {
        "reset_joints_by_offset": Entry(params=_JOINTS),
        "reset_joints_by_scale": Entry(params=_JOINTS),
        "reset_root_state_uniform": Entry(params=_ROOT),
        "reset_root_state_with_random_orientation": Entry(params=_ROOT),
        "push_by_setting_velocity": Entry(params={"velocity_range": _velocity}),
        "apply_external_force_torque": Entry(params={"force_range": "force", "torque_range": "torque"}),
    },
    "curriculum": {
        "modify_reward_weight": Entry("stages"),
        "terrain_levels_vel": Entry("terrain_levels"),
    },
}
"""Section -> Isaac Lab's name -> what it is here."""

ACTIONS: dict[str, str] = {
    "JointEffortAction": "joint_effort",
    "JointPositionAction": "joint_position",
    "RelativeJointPositionAction": "relative_joint_position",
    "JointVelocityAction": "joint_velocity",
    "JointPositionToLimitsAction": "joint_position_to_limits",
    "EMAJointPositionToLimitsAction": "ema_joint_position_to_limits",
    "BinaryJointPositionAction": "binary_joint_position",
    "BinaryJointVelocityAction": "binary_joint_velocity",
    "DifferentialInverseKinematicsAction": "differential_inverse_kinematics",
}
"""Isaac Lab's class -> the action term."""

COMMANDS: dict[str, Entry] = {
    "NullCommand": Entry("null_command"),
    "UniformVelocityCommand": Entry(
        "uniform_velocity",
        {
            "heading_control_stiffness": "heading_stiffness",
            "rel_standing_envs": "rel_standing",
            "rel_heading_envs": "rel_heading",
        },
    ),
    "NormalVelocityCommand": Entry("normal_velocity", {"rel_standing_envs": "rel_standing"}),
    "UniformPoseCommand": Entry("uniform_pose", {"body_name": "bodies", "pos_x": "x", "pos_y": "y", "pos_z": "z"}),
    "UniformPose2dCommand": Entry("uniform_pose2d", {"pos_x": "x", "pos_y": "y"}),
}
"""Isaac Lab's class -> the command term; its `ranges` are parameters like the others."""

NEVER = 1.0e9
"""An interval that no episode lasts [s], for an infinite one."""


def seconds(value: Any) -> Any:
    """A range of times without infinities."""
    return [NEVER if math.isinf(end) else end for end in value]
