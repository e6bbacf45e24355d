"""Every term of the library with its parameters, and its value in each of three environments, computed by hand."""

from math import acos, cos, pi

import numpy as np
from numpy.linalg import norm

from rlcli.mdp import observations as o
from rlcli.mdp import rewards as r
from rlcli.mdp import success as u
from rlcli.mdp import terminations as t
from support.mdp_numbers import DEFAULT, HIPS, LIMIT, angle_of, inverse, positive, product, wrapped

ROBOT, ARM = {"entity": "robot"}, {"entity": "arm"}
ALL = {**ROBOT, "joints": ".*"}
LEGS = {**ROBOT, "bodies": ["leg_fl", "leg_fr", "leg_bl", "leg_br"]}
TIPS = {**ROBOT, "sites": ["leg_fl_tip", "leg_fr_tip", "leg_bl_tip", "leg_br_tip"]}
SOME = {**ROBOT, "joints": ["hip_br", "hip_fl"]}
VELOCITY, FEET = {**ROBOT, "command": "velocity"}, {"sensor": "feet"}
GRIP, FORE = {**ARM, "sites": "grip"}, {**ARM, "bodies": "fore"}
POSE = {**FORE, "command": "pose"}
THING, GOAL = {"object": "object"}, {"object": "object", "command": "world_pose"}
HANDLE = {**GRIP, "cabinet": "cabinet", "handle": "handle"}
LOW, HIGH = np.array([-LIMIT] * 3 + [-1.0]), np.array([LIMIT] * 3 + [0.5])
FASTEST = np.array([3.5, 1.0, 3.5, 3.5])


def way(s, target):
    return np.array(target)[:2] + s.origin[:2] - s.pos[:2]


def facing(s, target):
    return s.R[:2, 0] @ way(s, target) / norm(way(s, target))


def wanted_effort(s):
    return 20 * (s.ctrl - s.q) - 0.5 * s.v


def moving(s, threshold):
    return norm(s.velocity) > 0 or norm(s.lin_b[:2]) > threshold


def heading_frame(s):
    ahead = s.R[:2, 0] / norm(s.R[:2, 0])
    return np.array([ahead @ s.lin[:2], ahead[0] * s.lin[1] - ahead[1] * s.lin[0]])


def box_exit(s, x, z):
    return not (x[0] <= s.above[0] <= x[1]) or not (z[0] <= s.above[2] <= z[1])


def capped(x):
    return min(x * x, 0.04)


def trot(s):
    air, contact = s.feet.air_time, s.feet.contact_time
    error = 0.0
    for i, j in ((0, 3), (1, 2)):
        error += capped(air[i] - air[j]) + capped(contact[i] - contact[j])
    for i, j in ((0, 1), (0, 2), (3, 1), (3, 2)):
        error += capped(air[i] - contact[j]) + capped(contact[i] - air[j])
    return np.exp(-error / 0.5) * moving(s, 0.4)


def stepping(s):
    total = 0.0
    for air, contact in zip(s.feet.air_time, s.feet.contact_time, strict=True):
        longest = max(air, contact)
        on_the_move = longest if longest < 0.35 else 0.0
        total += on_the_move if moving(s, 0.4) else np.clip(contact - air, -0.35, 0.35)
    return total


def one_foot(s):
    down = s.feet.contact_time > 0
    lasted = min(c if d else a for c, a, d in zip(s.feet.contact_time, s.feet.air_time, down, strict=True))
    return min(lasted, 0.3) * (down.sum() == 1) * (norm(s.place[:2]) > 0.1)


def postures(s):
    speed = s.asked + abs(s.velocity[2])
    std = 0.1 if speed < 0.5 else np.array([0.2, 0.3, 0.4, 0.5]) if speed < 1.25 else 0.6
    return np.exp(-np.mean(((s.q - DEFAULT) / std) ** 2))


def gripped(s):
    z, x = s.fore_R[:, 2], s.fore_R[:, 0]
    a, b = -z @ s.handle_R[:, 0], -x @ s.handle_R[:, 1]
    return 0.5 * (np.sign(a) * a**2 + np.sign(b) * b**2)


def near_handle(s):
    d = norm(s.handle - s.grip)
    return (2 if d <= 1.2 else 1) / (1 + d**2) ** 2


def from_root(s, p, v, w, quat):
    return [*(s.R.T @ (p - s.pos)), *product(inverse(s.quat), quat), *(s.R.T @ v), *(s.R.T @ w)]


OBSERVATIONS = [
    (o.joint_pos, ALL, lambda s: s.q),
    (o.joint_pos, SOME, lambda s: [s.q[3], s.q[0]]),
    (o.joint_vel, SOME, lambda s: [s.v[3], s.v[0]]),
    (o.joint_pos_rel, ALL, lambda s: s.q - DEFAULT),
    (o.joint_vel_rel, ALL, lambda s: s.v),
    (o.joint_angle, SOME, lambda s: [wrapped(s.q[3]), wrapped(s.q[0])]),
    (o.joint_angle_sum, SOME, lambda s: [wrapped(s.q[3] + s.q[0])]),
    (o.joint_pos_limit_normalized, ALL, lambda s: (2 * s.q - LOW - HIGH) / (HIGH - LOW)),
    (o.joint_pos_limit_normalized, {**ARM, "joints": "elbow"}, lambda s: [0.0]),
    (o.joint_effort, SOME, lambda s: [s.effort[3], s.effort[0]]),
    (o.base_pos_z, ROBOT, lambda s: [s.pos[2] - s.origin[2]]),
    (o.base_lin_vel, ROBOT, lambda s: s.R.T @ s.lin),
    (o.base_ang_vel, ROBOT, lambda s: s.ang),
    (o.projected_gravity, ROBOT, lambda s: s.R.T @ s.gravity / norm(s.gravity)),
    (o.root_pos_w, ROBOT, lambda s: s.pos - s.origin),
    (o.root_quat_w, ROBOT, lambda s: s.quat),
    (o.root_quat_w, {**ROBOT, "make_quat_unique": True}, lambda s: positive(s.quat)),
    (o.root_lin_vel_w, ROBOT, lambda s: s.lin),
    (o.root_ang_vel_w, ROBOT, lambda s: s.R @ s.ang),
    (o.base_yaw_roll, ROBOT, lambda s: [s.rpy[2], s.rpy[0]]),
    (o.base_roll_pitch, ROBOT, lambda s: s.rpy[:2]),
    (o.base_up_proj, ROBOT, lambda s: [-s.down_b[2]]),
    (o.base_heading_proj, {**ROBOT, "target": (3.0, 1.0, 9.0)}, lambda s: [facing(s, [3, 1])]),
    (o.base_angle_to_target, {**ROBOT, "target": (3.0, 1.0, 9.0)}, lambda s: [
        wrapped(np.arctan2(way(s, [3, 1])[1], way(s, [3, 1])[0]) - np.arctan2(s.R[1, 0], s.R[0, 0]))]),
    (o.body_pose_w, {**ROBOT, "bodies": ["leg_br", "torso"]}, lambda s: [
        *(s.leg_pos[3] - s.origin), *s.leg_quat[3], *(s.pos - s.origin), *s.quat]),
    (o.body_projected_gravity_b, {**ROBOT, "bodies": ["torso", "leg_fr"]}, lambda s: [
        *s.down_b, *(s.leg_R[1].T @ s.down)]),
    (o.body_state_b, {**ROBOT, "bodies": ["leg_bl"]}, lambda s: from_root(
        s, s.leg_pos[2], s.leg_lin[2], s.leg_ang[2], s.leg_quat[2])),
    (o.last_action, {}, lambda s: s.action),
    (o.generated_commands, {"command": "velocity"}, lambda s: s.velocity),
    (o.body_to_goal, POSE, lambda s: s.base_R.T @ (s.goal - s.fore)),
    (o.body_to_goal, {**POSE, "columns": [2, 0]}, lambda s: (s.base_R.T @ (s.goal - s.fore))[[2, 0]]),
    (o.generated_commands, {"command": "velocity", "columns": [2, 0]}, lambda s: [s.velocity[2], s.velocity[0]]),
    (o.current_time_s, {}, lambda s: [s.steps * 0.02]),
    (o.remaining_time_s, {}, lambda s: [0.6 - s.steps * 0.02]),
    (o.sensor_data, {**ROBOT, "sensors": ["gyro", "acc"]}, lambda s: [*s.readings["gyro"], *s.readings["acc"]]),
    (o.imu_orientation, {**ROBOT, "sensors": "attitude"}, lambda s: s.readings["attitude"]),
    (o.imu_projected_gravity, {**ROBOT, "sensors": "attitude"}, lambda s: _turned_back(s.readings["attitude"], s.down)),
    (o.imu_ang_vel, {**ROBOT, "sensors": "gyro"}, lambda s: s.readings["gyro"]),
    (o.imu_lin_acc, {**ROBOT, "sensors": "acc"}, lambda s: s.readings["acc"]),
    (o.height_scan, {"sensor": "rays", "offset": 0.3}, lambda s: s.rays.position[2] - s.rays.hits[:, 2] - 0.3),
    (o.foot_height, TIPS, lambda s: s.tip[:, 2] - s.origin[2]),
    (o.foot_air_time, FEET, lambda s: s.feet.air_time),
    (o.foot_contact, FEET, lambda s: s.feet.found * 1.0),
    (o.foot_contact_forces, FEET, lambda s: np.ravel(
        np.sign(s.feet.force_history[0]) * np.log(1 + abs(s.feet.force_history[0])))),
    (o.fingers_contact_force_b, {**ROBOT, **FEET}, lambda s: np.ravel(s.feet.force_history[0] @ s.R)),
    (o.ee_pos, GRIP, lambda s: s.grip - s.origin),
    (o.ee_quat, GRIP, lambda s: positive(s.fore_quat)),
    (o.ee_velocity, {**ROBOT, "sites": ["leg_fr_tip", "leg_bl_tip"]}, lambda s: [
        *(s.R.T @ s.tip_lin[1]), *(s.R.T @ s.tip_lin[2])]),
    (o.object_position_in_robot_root_frame, {**ROBOT, **THING}, lambda s: s.R.T @ (s.thing - s.pos)),
    (o.object_quat_b, {**ROBOT, **THING}, lambda s: product(inverse(s.quat), s.thing_quat)),
    (o.rel_ee_object_distance, {**GRIP, **THING}, lambda s: s.thing - s.grip),
    (o.ee_to_object_distance, {**GRIP, **THING}, lambda s: s.base_R.T @ (s.thing - s.grip)),
    (o.RelEeDrawerDistance, HANDLE, lambda s: s.handle - s.grip),
    (o.object_to_goal_distance, {**ARM, **THING, "command": "pose"}, lambda s: s.base_R.T @ (s.goal - s.thing)),
    (o.goal_quat_diff, {**GOAL, "make_quat_unique": True}, lambda s: positive(
        product(s.thing_quat, inverse(s.goal_quat)))),
]  # fmt: skip


def _turned_back(quat, vector):
    return product(inverse(quat), product([0, *vector], quat))[1:]


REWARDS = [
    (r.is_alive, {}, lambda s: not s.terminated),
    (r.is_terminated, {}, lambda s: s.terminated),
    (r.IsTerminatedTerm, {"terms": ["fell", "low"]}, lambda s: 2.0 * s.terminated * (not s.timed_out)),
    (r.IsTerminatedTerm, {"terms": ["fell"]}, lambda s: 1.0 * s.terminated * (not s.timed_out)),
    (r.joint_pos_target_l2, {**SOME, "target": 0.5}, lambda s: (s.q[3] - 0.5) ** 2 + (s.q[0] - 0.5) ** 2),
    (r.joint_vel_l1, SOME, lambda s: abs(s.v[3]) + abs(s.v[0])),
    (r.joint_vel_l2, ALL, lambda s: s.v @ s.v),
    (r.joint_acc_l2, SOME, lambda s: s.acc[3] ** 2 + s.acc[0] ** 2),
    (r.joint_torques_l2, ALL, lambda s: s.effort @ s.effort),
    (r.joint_pos_limits, ALL, lambda s: np.maximum(LOW - s.q, 0).sum() + np.maximum(s.q - HIGH, 0).sum()),
    (r.JointPosLimitsPenaltyRatio, {**ROBOT, "joints": HIPS[:3], "threshold": 0.25, "gear_ratio": [2.0, 2.5, 3.0]},
     lambda s: sum(g * max(abs(q) / LIMIT - 0.25, 0) / 0.75 for q, g in zip(s.q[:3], (2, 2.5, 3), strict=True))),
    (r.joints_at_limit, {**ALL, "threshold": 0.25}, lambda s:
     sum(abs(2 * q - a - b) / (b - a) > 0.25 for q, a, b in zip(s.q, LOW, HIGH, strict=True))),
    (r.joints_at_limit, {**ROBOT, "joints": HIPS[:3]}, lambda s: sum(abs(q) / LIMIT > 0.99 for q in s.q[:3])),
    (r.PowerConsumption, {**ALL, "gear_ratio": 2.0}, lambda s: 2 * abs(s.action * s.v).sum()),
    (r.action_rate_l2, {}, lambda s: ((s.action - s.previous) ** 2).sum()),
    (r.action_l2, {}, lambda s: s.action @ s.action),
    (r.ActionAccL2, {}, lambda s: ((s.action - 2 * s.previous) ** 2).sum()),
    (r.action_smoothness_penalty, {}, lambda s: norm(s.action - s.previous)),
    (r.lin_vel_z_l2, ROBOT, lambda s: s.lin_b[2] ** 2),
    (r.ang_vel_xy_l2, ROBOT, lambda s: s.ang[0] ** 2 + s.ang[1] ** 2),
    (r.flat_orientation_l2, ROBOT, lambda s: s.down_b[0] ** 2 + s.down_b[1] ** 2),
    (r.upright_posture_bonus, {**ROBOT, "threshold": 0.45}, lambda s: -s.down_b[2] > 0.45),
    (r.move_to_target_bonus, {**ROBOT, "threshold": 0.8, "target": (3.0, 1.0, 0.0)}, lambda s:
     1.0 if facing(s, [3, 1]) > 0.8 else facing(s, [3, 1]) / 0.8),
    (r.ProgressReward, {**ROBOT, "target": (3.0, 1.0, 0.0)}, lambda s: 0.0),
    (r.base_height_l2, {**ROBOT, "target_height": 0.3}, lambda s: (s.pos[2] - s.origin[2] - 0.3) ** 2),
    (r.base_height_l2, {**ROBOT, "target_height": 0.3, "sensor": "rays"}, lambda s:
     (s.pos[2] - s.rays.hits[:, 2].mean() - 0.3) ** 2),
    (r.upright, {**ROBOT, "std": 0.5}, lambda s: np.exp(-(s.down_b[0] ** 2 + s.down_b[1] ** 2) / 0.25)),
    (r.base_motion_penalty, ROBOT, lambda s: 0.8 * s.lin_b[2] ** 2 + 0.2 * (abs(s.ang[0]) + abs(s.ang[1]))),
    (r.base_orientation_penalty, ROBOT, lambda s: norm(s.down_b[:2])),
    (r.lin_vel_xyz_exp, {**ROBOT, "std": 2.0}, lambda s: np.exp(-s.lin @ s.lin / 4)),
    (r.ang_vel_xyz_exp, {**ROBOT, "std": 2.0}, lambda s: np.exp(-s.ang @ s.ang / 4)),
    (r.yaw_aligned, {**ROBOT, "std": 2.0}, lambda s: np.exp(-(s.rpy[2] ** 2) / 4)),
    (r.body_angular_velocity_penalty, {**ROBOT, "bodies": ["torso", "leg_fr"]}, lambda s:
     s.ang[0] ** 2 + s.ang[1] ** 2 + ((s.leg_R[1].T @ s.leg_ang[1])[:2] ** 2).sum()),
    (r.angular_momentum_penalty, {**ROBOT, "sensors": "spin"}, lambda s: s.readings["spin"] @ s.readings["spin"]),
    (r.joint_deviation_l1, SOME, lambda s: abs(s.q[3] + 0.1) + abs(s.q[0] - 0.1)),
    (r.stand_still_joint_deviation_l1, {**ALL, "command": "velocity"}, lambda s:
     abs(s.q - DEFAULT).sum() * (s.asked < 0.06)),
    (r.joint_vel_limits, {**ALL, "soft_ratio": 0.9}, lambda s: np.clip(abs(s.v) - 0.9 * FASTEST, 0, 1).sum()),
    (r.joint_velocity_hinge_penalty, {**ALL, "max_velocity": 1.5}, lambda s:
     (np.maximum(abs(s.v) - 1.5, 0) ** 2).sum()),
    (r.applied_torque_limits, ALL, lambda s: np.maximum(abs(wanted_effort(s)) - 8, 0).sum()),
    (r.applied_torque_limits, {**ARM, "joints": ".*"}, lambda s: max(abs(2 * s.arm_ctrl) - 12, 0)),
    (r.electrical_power_cost, ALL, lambda s: np.maximum(s.effort * s.v, 0).sum()),
    (r.joint_acceleration_penalty, ALL, lambda s: norm(s.acc)),
    (r.joint_torques_penalty, ALL, lambda s: norm(s.effort)),
    (r.joint_velocity_penalty, SOME, lambda s: np.hypot(s.v[3], s.v[0])),
    (r.joint_position_penalty, {**ALL, "command": "velocity", "stand_still_scale": 5.0, "velocity_threshold": 0.9},
     lambda s: norm(s.q - DEFAULT) * (1 if moving(s, 0.9) else 5)),
    (r.Posture, {**ALL, "std": [0.1, 0.2, 0.5, 0.8]}, lambda s:
     np.exp(-np.mean(((s.q - DEFAULT) / [0.1, 0.2, 0.5, 0.8]) ** 2))),
    (r.Posture, {**SOME, "std": 0.9}, lambda s: np.exp(-((s.q[3] + 0.1) ** 2 + (s.q[0] - 0.1) ** 2) / 0.81 / 2)),
    (r.VariablePosture, {**ALL, "command": "velocity", "std_standing": 0.1, "std_walking": [0.2, 0.3, 0.4, 0.5],
                         "std_running": 0.6, "walking_threshold": 0.5, "running_threshold": 1.25}, postures),
    (r.track_lin_vel_xy_exp, {**VELOCITY, "std": 0.7}, lambda s:
     np.exp(-((s.velocity[:2] - s.lin_b[:2]) ** 2).sum() / 0.49)),
    (r.track_ang_vel_z_exp, {**VELOCITY, "std": 0.7}, lambda s: np.exp(-((s.velocity[2] - s.ang[2]) ** 2) / 0.49)),
    (r.track_lin_vel_xy_yaw_frame_exp, {**VELOCITY, "std": 0.7}, lambda s:
     np.exp(-((s.velocity[:2] - heading_frame(s)) ** 2).sum() / 0.49)),
    (r.track_ang_vel_z_world_exp, {**VELOCITY, "std": 0.7}, lambda s:
     np.exp(-((s.velocity[2] - s.ang_w[2]) ** 2) / 0.49)),
    (r.track_linear_velocity, {**VELOCITY, "std": 0.7}, lambda s:
     np.exp(-(((s.velocity[:2] - s.lin_b[:2]) ** 2).sum() + s.lin_b[2] ** 2) / 0.49)),
    (r.track_angular_velocity, {**VELOCITY, "std": 0.7}, lambda s:
     np.exp(-((s.velocity[2] - s.ang[2]) ** 2 + s.ang[0] ** 2 + s.ang[1] ** 2) / 0.49)),
    (r.base_linear_velocity_reward, {**VELOCITY, "std": 0.7, "ramp_at_vel": 0.5, "ramp_rate": 2.0}, lambda s:
     np.exp(-norm(s.velocity[:2] - s.lin_b[:2]) / 0.7) * max(1, 1 + 2 * (s.asked - 0.5))),
    (r.base_angular_velocity_reward, {**VELOCITY, "std": 0.7}, lambda s:
     np.exp(-abs(s.velocity[2] - s.ang[2]) / 0.7)),
    (r.undesired_contacts, {**FEET, "threshold": 3.0}, lambda s: (s.strongest > 3).sum()),
    (r.desired_contacts, {**FEET, "threshold": 3.9}, lambda s: not (s.strongest > 3.9).any()),
    (r.contact_forces, {**FEET, "threshold": 2.0}, lambda s: np.maximum(s.strongest - 2, 0).sum()),
    (r.self_collision_cost, FEET, lambda s: s.feet.found.sum()),
    (r.feet_air_time, {**FEET, "command": "velocity", "threshold": 0.5}, lambda s:
     ((s.feet.last_air_time - 0.5) * s.feet.first_contact).sum() * (s.asked > 0.1)),
    (r.feet_air_time, {**FEET, "command": "place", "threshold": 0.5}, lambda s:
     ((s.feet.last_air_time - 0.5) * s.feet.first_contact).sum() * (norm(s.place[:2]) > 0.1)),
    (r.feet_air_time_positive_biped, {**FEET, "command": "place", "threshold": 0.3}, one_foot),
    (r.feet_slide, {**LEGS, **FEET}, lambda s: (norm(s.leg_lin[:, :2], axis=1) * (s.strongest > 1)).sum()),
    (r.foot_slip_penalty, {**LEGS, **FEET, "threshold": 3.0}, lambda s:
     (norm(s.leg_lin[:, :2], axis=1) * (s.strongest > 3)).sum()),
    (r.feet_slip, {**TIPS, **FEET, "command": "velocity", "command_threshold": 0.04}, lambda s:
     ((s.tip_lin[:, :2] ** 2).sum(axis=1) * s.feet.found).sum() * (s.asked > 0.04)),
    (r.foot_clearance_reward, {**LEGS, "target_height": 0.1, "std": 0.5, "tanh_mult": 2.0}, lambda s: np.exp(-(
        (s.leg_pos[:, 2] - s.origin[2] - 0.1) ** 2 * np.tanh(2 * norm(s.leg_lin[:, :2], axis=1))).sum() / 0.5)),
    (r.feet_clearance, {**TIPS, "target_height": 0.1, "command": "velocity", "command_threshold": 0.04}, lambda s:
     (abs(s.tip[:, 2] - s.origin[2] - 0.1) * norm(s.tip_lin[:, :2], axis=1)).sum() * (s.asked > 0.04)),
    (r.FeetSwingHeight, {**TIPS, **FEET, "target_height": 0.1, "command": "velocity", "command_threshold": 0.04},
     lambda s: ((np.maximum(s.tip[:, 2] - s.origin[2], 0) / 0.1 - 1) ** 2 * s.feet.first_contact).sum()
     * (s.asked > 0.04)),
    (r.soft_landing, {**FEET, "command": "velocity", "command_threshold": 0.04}, lambda s:
     (norm(s.feet.force_history[0], axis=1) * s.feet.first_contact).sum() * (s.asked > 0.04)),
    (r.air_time_reward, {**VELOCITY, **FEET, "mode_time": 0.35, "velocity_threshold": 0.4}, stepping),
    (r.air_time_variance_penalty, FEET, lambda s: np.var(np.minimum(s.feet.last_air_time, 0.5), ddof=1)
     + np.var(np.minimum(s.feet.last_contact_time, 0.5), ddof=1)),
    (r.GaitReward, {**VELOCITY, **FEET, "std": 0.5, "max_err": 0.2, "velocity_threshold": 0.4,
                    "synced_feet_pairs": (("leg_fl", "leg_br"), ("leg_fr", "leg_bl"))}, trot),
    (r.position_command_error, POSE, lambda s: norm(s.fore - s.goal)),
    (r.position_command_error_tanh, {**POSE, "std": 0.4}, lambda s: 1 - np.tanh(norm(s.fore - s.goal) / 0.4)),
    (r.orientation_command_error, POSE, lambda s: angle_of(product(inverse(s.fore_quat), s.goal_quat))),
    (r.orientation_command_error_tanh, {**POSE, "std": 0.9}, lambda s:
     1 - np.tanh(angle_of(product(inverse(s.fore_quat), s.goal_quat)) / 0.9)),
    (r.goal_distance_tanh, {"command": "place", "std": 2.0}, lambda s: 1 - np.tanh(norm(s.place[:3]) / 2)),
    (r.heading_command_error_abs, {"command": "place"}, lambda s: abs(s.place[3])),
    (r.distance_to_goal_exp, {**ROBOT, "command": "place", "std": 2.0}, lambda s:
     np.exp(-((s.place[:3] + s.origin - s.pos) ** 2).sum() / 4)),
    (r.object_is_lifted, {**THING, "minimal_height": 0.2}, lambda s: s.thing[2] - s.origin[2] > 0.2),
    (r.object_is_lifted, {**GRIP, **THING, "minimal_height": 0.2, "held_within": 1.2}, lambda s:
     (s.thing[2] - s.origin[2] > 0.2) * (norm(s.thing - s.grip) <= 1.2)),
    (r.object_ee_distance, {**GRIP, **THING, "std": 0.5}, lambda s: 1 - np.tanh(norm(s.thing - s.grip) / 0.5)),
    (r.grasp_object, {**GRIP, **THING, "joints": "finger", "threshold": 1.2, "open_joint_pos": 0.04}, lambda s:
     (0.04 - s.arm[2]) * (norm(s.thing - s.grip) <= 1.2)),
    (r.object_goal_distance, {**ARM, **THING, "command": "pose", "std": 0.5, "minimal_height": 0.2}, lambda s:
     (1 - np.tanh(norm(s.thing - s.goal) / 0.5)) * (s.thing[2] - s.origin[2] > 0.2)),
    (r.object_goal_distance,
     {**GRIP, **THING, "command": "pose", "std": 0.5, "minimal_height": 0.2, "held_within": 1.2}, lambda s:
     (1 - np.tanh(norm(s.thing - s.goal) / 0.5)) * (s.thing[2] - s.origin[2] > 0.2) * (norm(s.thing - s.grip) <= 1.2)),
    (r.success_bonus, {**GOAL, "threshold": 1.7}, lambda s:
     angle_of(product(inverse(s.thing_quat), s.goal_quat)) <= 1.7),
    (r.track_pos_l2, GOAL, lambda s: norm(s.goal + s.origin - s.thing)),
    (r.track_orientation_inv_l2, {**GOAL, "rot_eps": 0.1}, lambda s:
     1 / (angle_of(product(inverse(s.thing_quat), s.goal_quat)) + 0.1)),
    (r.ApproachEeHandle, {**HANDLE, "threshold": 1.2}, near_handle),
    (r.AlignEeHandle, HANDLE, gripped),
    (r.GraspHandle, {**HANDLE, "joints": "finger", "threshold": 1.2, "open_joint_pos": 0.04}, lambda s:
     (0.04 - s.arm[2]) * (norm(s.handle - s.grip) <= 1.2)),
    (r.open_drawer_bonus, {"entity": "cabinet", "joints": "slide"}, lambda s: s.drawer),
    (r.multi_stage_open_drawer, {"entity": "cabinet", "joints": "slide"}, lambda s:
     0.5 * (s.drawer > 0.01) + (s.drawer > 0.2) + (s.drawer > 0.3)),
]  # fmt: skip

TERMINATIONS = [
    (t.time_out, {}, lambda s: s.steps >= 30),
    (t.joint_pos_out_of_manual_limit, {**ALL, "bounds": (-0.25, 0.35)}, lambda s: min(s.q) < -0.25 or max(s.q) > 0.35),
    (t.joint_pos_out_of_manual_limit, {**SOME, "bounds": (-0.15, 0.15)}, lambda s:
     min(s.q[0], s.q[3]) < -0.15 or max(s.q[0], s.q[3]) > 0.15),
    (t.joint_pos_out_of_limit, ALL, lambda s: (s.q < LOW).any() or (s.q > HIGH).any()),
    (t.joint_vel_out_of_limit, {**ROBOT, "joints": HIPS[:3]}, lambda s: (abs(s.v) > FASTEST)[:3].any()),
    (t.joint_vel_out_of_manual_limit, {**ALL, "max_velocity": 4.5}, lambda s: max(abs(s.v)) > 4.5),
    (t.joint_effort_out_of_limit, ALL, lambda s: (abs(wanted_effort(s)) > 8).any()),
    (t.joint_effort_out_of_limit, {**ARM, "joints": ".*"}, lambda s: abs(2 * s.arm_ctrl) > 12),
    (t.bad_orientation, {**ROBOT, "limit_angle": 0.7}, lambda s: -s.down_b[2] < cos(0.7)),
    (t.root_height_below_minimum, {**ROBOT, "minimum_height": 0.3}, lambda s: s.pos[2] - s.origin[2] < 0.3),
    (t.illegal_contact, {**FEET, "threshold": 3.5}, lambda s: (s.strongest > 3.5).any()),
    (t.out_of_bound, {**ROBOT, "x": (-0.1, 0.9), "z": (0.1, 0.6)}, lambda s: box_exit(s, (-0.1, 0.9), (0.1, 0.6))),
    (t.out_of_bound, {**ROBOT, "y": (-1.0, 1.0)}, lambda s: abs(s.above[1]) > 1.0),
    (t.abnormal_robot_state, ALL, lambda s: (abs(s.v) > 2 * FASTEST).any()),
    (t.object_reached_goal, {**ARM, **THING, "command": "pose", "threshold": 0.5}, lambda s:
     norm(s.goal - s.thing) < 0.5),
    (t.object_away_from_goal, {**GOAL, "threshold": 1.5}, lambda s: norm(s.goal + s.origin - s.thing) > 1.5),
    (t.object_away_from_robot, {**ROBOT, **THING, "threshold": 3.0}, lambda s: norm(s.pos - s.thing) > 3.0),
]  # fmt: skip

SUCCESS = [
    (u.joint_error, {**ROBOT, "joints": ["hip_fl", "hip_bl"], "target": 0.2}, lambda s:
     max(abs(s.q[0] - 0.2), abs(s.q[2] - 0.2))),
    (u.joint_error, {**ROBOT, "joints": ["hip_fl"], "target": 0.1 + 2 * pi}, lambda s: abs(s.q[0] - 0.1)),
    (u.root_velocity, {**ROBOT, "direction": (0.6, 0.0, 0.8)}, lambda s: 0.6 * s.lin[0] + 0.8 * s.lin[2]),
    (u.root_speed, ROBOT, lambda s: norm(s.lin)),
    (u.root_tilt, ROBOT, lambda s: acos(-s.down_b[2])),
    (u.root_height, ROBOT, lambda s: s.above[2]),
    (u.root_distance, {**ROBOT, "target": (0.5, -0.5, 0.5)}, lambda s: norm(s.above - [0.5, -0.5, 0.5])),
    (u.root_distance_to, {**ROBOT, "goal": "object"}, lambda s: norm(s.pos - s.thing)),
    (u.velocity_error, VELOCITY, lambda s: norm(s.velocity[:2] - s.lin_b[:2])),
    (u.yaw_rate_error, VELOCITY, lambda s: abs(s.velocity[2] - s.ang[2])),
    (u.body_goal_distance, POSE, lambda s: norm(s.fore - s.goal)),
    (u.body_goal_angle, POSE, lambda s: angle_of(product(inverse(s.fore_quat), s.goal_quat))),
    (u.site_goal_distance, {**GRIP, "command": "pose"}, lambda s: norm(s.grip - s.goal)),
    (u.object_goal_distance, {**ARM, **THING, "command": "pose"}, lambda s: norm(s.thing - s.goal)),
]  # fmt: skip

ROWS = [*OBSERVATIONS, *REWARDS, *TERMINATIONS, *SUCCESS]
