"""Tables of Isaac Lab's terms and their counterparts in rlcli.

A term that is in no table has the same name and parameters in both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

Translate = Callable[[Any], dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Entry:
    """Counterpart in rlcli of one of Isaac Lab's terms, which has another name, other parameters or another result."""

    name: str | None = None
    params: Mapping[str, str | Translate] = field(default_factory=dict)
    note: str | None = None
    """Note for the user on how the value of the counterpart differs from Isaac Lab's; None: it does not differ."""
    fixed: Mapping[str, Any] = field(default_factory=dict)
    """Parameters of the counterpart that Isaac Lab's code sets to constants, or to the default of `asset_cfg`."""


def _pose(value: Mapping[str, Any]) -> dict[str, Any]:
    return {axis: value[axis] for axis in ("x", "y", "z", "roll", "pitch", "yaw") if axis in value}


def _velocity(value: Mapping[str, Any]) -> dict[str, Any]:
    still = (0.0, 0.0)
    ranges_by_key = {
        "linear_velocity": [value.get(axis, still) for axis in ("x", "y", "z")],
        "angular_velocity": [value.get(axis, still) for axis in ("roll", "pitch", "yaw")],
    }
    return {key: ranges for key, ranges in ranges_by_key.items() if any(tuple(r) != still for r in ranges)}


def _xyz(value: Mapping[str, Any]) -> dict[str, Any]:
    return {axis: value[axis] for axis in ("x", "y", "z") if axis in value}


def _bounds(value: Mapping[str, Any]) -> dict[str, Any]:
    """Return the range (low, high) of each of the axes x, y and z; as in Isaac Lab, a missing one is (0, 0)."""
    return {axis: value.get(axis, (0.0, 0.0)) for axis in ("x", "y", "z")}


def _nothing(value: Any) -> dict[str, Any]:
    return {}


def _names(value: Any) -> dict[str, Any]:
    return {"terms": [value] if isinstance(value, str) else list(value)}


def _unwrap_single(value: Any) -> dict[str, Any]:
    """Return the parameter `sensor` from a list with one sensor. The check of the term rejects longer lists."""
    return {"sensor": value[0] if len(value) == 1 else list(value)}


_JOINTS: dict[str, str | Translate] = {"position_range": "position", "velocity_range": "velocity"}
_ROOT: dict[str, str | Translate] = {"pose_range": _pose, "velocity_range": _velocity}
_TARGET: dict[str, str | Translate] = {"target_pos": "target"}

_ACCELERATION = "MuJoCo's acceleration, not the change of velocity in the last physics step divided by its time"
_PRESENT = "efforts of MuJoCo's own actuators are those of the present state, not of the last physics step"

TERMS: dict[str, dict[str, Entry]] = {
    "observations": {
        "height_scan": Entry(note="a ray without a hit has the sensor's maximum distance, not infinity"),
        "body_incoming_wrench": Entry(note="about the body's origin, in its frame; in PhysX: the joint's frame"),
        "imu_lin_acc": Entry(note=_ACCELERATION),
        "image": Entry(params=dict.fromkeys(("data_type", "convert_perspective_to_orthogonal", "permute"), _nothing)),
        "base_heading_proj": Entry(params=_TARGET),
        "base_angle_to_target": Entry(params=_TARGET),
        "fingertips_pos": Entry("ee_pos"),
        "ee_frame_pos": Entry("ee_pos"),
        "ee_frame_quat": Entry("ee_quat"),
        "object_pos_b": Entry("object_position_in_robot_root_frame"),
        "object_obs": Entry("rel_ee_object_distance"),
        "gripper_pos": Entry("joint_pos"),
        "fingers_contact_force_b": Entry(params={"contact_sensor_names": _unwrap_single}),
        "cube_positions_in_world_frame": Entry("root_pos_w"),
        "cube_orientations_in_world_frame": Entry("root_quat_w"),
    },
    "rewards": {
        "is_terminated_term": Entry(params={"term_keys": _names}),
        "move_to_target_bonus": Entry(params=_TARGET),
        "progress_reward": Entry(
            params=_TARGET,
            note="the first step of an episode excludes the difference in height, which Isaac Lab counts",
        ),
        "body_lin_acc_l2": Entry(note=_ACCELERATION),
        "joint_acc_l2": Entry(note=_ACCELERATION),
        "joint_acceleration_penalty": Entry(note=_ACCELERATION),
        "applied_torque_limits": Entry(note=_PRESENT),
        "open_drawer_bonus": Entry(note="not doubled while the handle is grasped, as it is in Isaac Lab"),
        "multi_stage_open_drawer": Entry(note="the later stages do not require a grasp, as they do in Isaac Lab"),
        "orientation_command_error_tanh": Entry(
            note="the orientation of a body of the robot, not of an object, whether or not it is touched"
        ),
        "GaitReward": Entry("gait_reward"),
        "action_l2_clamped": Entry("action_l2", note="not clamped to 1000"),
        "action_rate_l2_clamped": Entry("action_rate_l2", note="not clamped to 1000"),
    },
    "terminations": {
        "joint_effort_out_of_limit": Entry(note=_PRESENT),
        "out_of_bound": Entry(params={"in_bound_range": _bounds}, fixed={"entity": "object"}),
        "terrain_out_of_bounds": Entry(
            "out_of_bound", {"distance_buffer": lambda value: {}}, "set the terrain's bounds: x and y of out_of_bound"
        ),
    },
    "events": {
        "reset_joints_by_offset": Entry(params=_JOINTS),
        "reset_joints_around_default": Entry("reset_joints_by_offset", _JOINTS),
        "reset_joints_within_limits_range": Entry("reset_joints_within_limits", _JOINTS),
        "reset_joints_by_scale": Entry(params=_JOINTS),
        "reset_root_state_uniform": Entry(params=_ROOT),
        "reset_root_state_with_random_orientation": Entry(params=_ROOT | {"pose_range": _xyz}),
        "push_by_setting_velocity": Entry(params={"velocity_range": _velocity}),
        "apply_external_force_torque": Entry(
            params={"force_range": "force", "torque_range": "torque"},
            note="force and torque keep their direction in the world frame, not in the body's frame",
        ),
        "reset_scene_to_default": Entry(params={"reset_joint_targets": lambda value: {}}),
        "randomize_rigid_body_scale": Entry("randomize_geom_size"),
        "randomize_rigid_body_material": Entry("randomize_geom_friction"),
        "randomize_rigid_body_mass": Entry("randomize_body_mass"),
        "randomize_rigid_body_com": Entry("randomize_body_com"),
        "randomize_rigid_body_collider_offsets": Entry("randomize_model_field"),
        "randomize_physics_scene_gravity": Entry("randomize_gravity"),
        "randomize_joint_parameters": Entry("randomize_joint_armature"),
        "randomize_fixed_tendon_parameters": Entry("randomize_tendon_stiffness"),
        "randomize_joint_by_gaussian_offset": Entry("reset_joints_by_gaussian"),
        "randomize_object_pose": Entry("reset_root_state_uniform", _ROOT),
    },
    "curriculum": {
        "modify_reward_weight": Entry("stages"),
        "terrain_levels_vel": Entry("terrain_levels", fixed={"command": "base_velocity"}),
    },
}
"""Section -> Isaac Lab's name of a term -> counterpart. `randomization.py` translates randomisation events."""

HEIGHT_TERMS = {
    "base_pos_z",
    "root_height_below_minimum",
    "base_height_l2",
    "object_is_lifted",
    "object_goal_distance",
    "foot_clearance_reward",
}
"""Terms whose heights are relative to the environment's origin; in Isaac Lab they are relative to z = 0."""

EFFORT_TERMS = {
    "joint_effort",
    "joint_torques_l2",
    "joint_torques_penalty",
    "applied_torque_limits",
    "joint_effort_out_of_limit",
}
"""Terms that read the efforts of actuators."""

ACTIONS: dict[str, str] = {
    "JointEffortAction": "joint_effort",
    "JointPositionAction": "joint_position",
    "RelativeJointPositionAction": "relative_joint_position",
    "JointVelocityAction": "joint_velocity",
    "JointPositionToLimitsAction": "joint_position_to_limits",
    "EMAJointPositionToLimitsAction": "ema_joint_position_to_limits",
    "BinaryJointPositionAction": "binary_joint_position",
    "BinaryJointVelocityAction": "binary_joint_velocity",
    "AbsBinaryJointPositionAction": "binary_joint_position",
    "DifferentialInverseKinematicsAction": "differential_inverse_kinematics",
}
"""Isaac Lab's class -> action term."""

ONCE_PER_STEP = {"RelativeJointPositionAction", "DifferentialInverseKinematicsAction"}
"""Actions whose targets Isaac Lab computes again in each physics step; rlcli does so once per environment step."""

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
"""Isaac Lab's class -> command term. Its `ranges` become parameters of the term."""

NEVER = 1.0e9
"""Time that no episode reaches [s]. It replaces infinity, which a YAML task cannot hold."""


def finite_times(value: Any) -> Any:
    """Return a range (low, high) of times [s], in which NEVER replaces infinity."""
    return [NEVER if math.isinf(end) else end for end in value]
