"""Observation terms. Each returns a tensor (num_envs, k); `image` returns (num_envs, c, h, w)."""

from __future__ import annotations

import torch
from torch import Tensor

from rlcli.mdp.parameter_types import CameraSensor, Command, ContactSensor, Entity, ManagedEnv, RaySensor
from rlcli.mdp.term_helpers import HandleTerm, constant, goal_in_world, single
from rlcli.sim.rotations import atan2, conjugate, length, multiply, roll_pitch_yaw, rotate_inverse, unique, wrap_to_pi
from rlcli.task import Bodies, Joints, Sensors, Sites, reads_body_forces


def joint_pos(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Joint positions [m or rad]. (num_envs, k)"""
    return entity.data.joint_pos_of(joints)


def joint_vel(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Joint velocities [m/s or rad/s]. (num_envs, k)"""
    return entity.data.joint_vel_of(joints)


def joint_pos_rel(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Joint positions minus their defaults [m or rad]. (num_envs, k)"""
    return entity.data.joint_pos_of(joints) - entity.data.default_joint_pos_of(joints)


def joint_vel_rel(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Joint velocities minus their defaults [m/s or rad/s]. (num_envs, k)"""
    return entity.data.joint_vel_of(joints) - entity.data.default_joint_vel_of(joints)


def joint_angle(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Joint positions wrapped to [-pi, pi], for hinges without limits [rad]. (num_envs, k)"""
    return entity.data.joint_angle_of(joints)


def joint_angle_sum(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints) -> Tensor:
    """Sum of joint positions, wrapped to [-pi, pi]: the angle of the last link of a planar chain [rad].

    (num_envs, 1)
    """
    position = entity.data.joint_pos_of(joints)
    angle = position[:, :1]
    for column in position.split(1, dim=1)[1:]:  # one by one: the rounding of `sum` depends on num_envs
        angle = angle + column
    return wrap_to_pi(angle)


def joint_pos_limit_normalized(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Joint positions, -1 at the lower and 1 at the upper soft limit; 0 for a joint without limits. (num_envs, k)"""
    low, high = entity.data.joint_limits_of(joints, soft=True)
    scaled = (2.0 * entity.data.joint_pos_of(joints) - low - high) / (high - low)
    return torch.where(high - low < torch.inf, scaled, 0.0)


def joint_effort(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Efforts of the actuators on the joints in the last substep, after their limits [N or N m]. (num_envs, k)"""
    return entity.data.applied_effort[:, joints]


def base_pos_z(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Height of the root above its environment's origin [m]. (num_envs, 1)"""
    return entity.data.root_pos_w[:, 2:3] - env.origins[:, 2:3]


def base_lin_vel(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Linear velocity of the root in its own frame [m/s]. (num_envs, 3)"""
    return entity.data.root_lin_vel_b


def base_ang_vel(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Angular velocity of the root in its own frame [rad/s]. (num_envs, 3)"""
    return entity.data.root_ang_vel_b


def projected_gravity(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Direction of gravity in the root's frame, a unit vector. (num_envs, 3)"""
    return entity.data.projected_gravity_b


def root_pos_w(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Position of the root from its environment's origin, world frame [m]. (num_envs, 3)"""
    return entity.data.root_pos_w - env.origins


def root_quat_w(env: ManagedEnv, *, entity: Entity = "robot", make_quat_unique: bool = False) -> Tensor:
    """Orientation of the root, quaternion (w, x, y, z), world frame. (num_envs, 4)

    make_quat_unique: use the quaternion with w >= 0.
    """
    quat = entity.data.root_quat_w
    return unique(quat) if make_quat_unique else quat


def root_lin_vel_w(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Linear velocity of the root, world frame [m/s]. (num_envs, 3)"""
    return entity.data.root_lin_vel_w


def root_ang_vel_w(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Angular velocity of the root, world frame [rad/s]. (num_envs, 3)"""
    return entity.data.root_ang_vel_w


def base_yaw_roll(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Yaw and roll of the root [rad]. (num_envs, 2)"""
    roll, _, yaw = roll_pitch_yaw(entity.data.root_quat_w)
    return torch.stack([yaw, roll], dim=1)


def base_roll_pitch(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Roll and pitch of the root [rad]. (num_envs, 2)"""
    roll, pitch, _ = roll_pitch_yaw(entity.data.root_quat_w)
    return torch.stack([roll, pitch], dim=1)


def base_up_proj(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Cosine between the root's up axis and the world's: 1 upright, -1 upside down. (num_envs, 1)"""
    return -entity.data.projected_gravity_b[:, 2:3]


def base_heading_proj(env: ManagedEnv, *, entity: Entity = "robot", target: tuple[float, float, float]) -> Tensor:
    """Cosine between the root's forward axis and the horizontal direction to `target`. (num_envs, 1)

    target: a point from the environment's origin [m].
    """
    offset = _offset_xy(env, entity, target)
    return (entity.data.forward_w[:, :2] * offset).sum(dim=1, keepdim=True) / length(offset).clamp_(min=1e-9)[:, None]


def base_angle_to_target(env: ManagedEnv, *, entity: Entity = "robot", target: tuple[float, float, float]) -> Tensor:
    """Angle from the root's heading to `target`, about the vertical [rad]. (num_envs, 1)

    In [-pi, pi]. target: a point from the environment's origin [m].
    """
    offset = _offset_xy(env, entity, target)
    return wrap_to_pi(atan2(offset[:, 1], offset[:, 0]) - entity.data.heading_w)[:, None]


def body_pose_w(env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies = ".*") -> Tensor:
    """Position in m and quaternion (w, x, y, z) of each body, world frame. (num_envs, 7 k)

    The position is relative to the environment's origin.
    """
    position = entity.data.body_pos_w[:, bodies] - env.origins[:, None]
    return torch.cat([position, entity.data.body_quat_w[:, bodies]], dim=2).flatten(1)


def body_projected_gravity_b(env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies = ".*") -> Tensor:
    """Direction of gravity in each body's frame, unit vectors. (num_envs, 3 k)"""
    quat = entity.data.body_quat_w[:, bodies]
    return rotate_inverse(quat, entity.data.down_w[:, None].expand(-1, quat.shape[1], -1)).flatten(1)


def body_state_b(env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies = ".*") -> Tensor:
    """State of each body relative to the root's position, in the root's frame. (num_envs, 13 k)

    Position in m, quaternion (w, x, y, z), linear velocity in m/s, angular velocity in rad/s. The velocities are
    relative to the world, with their axes in the root's frame.
    """
    data = entity.data
    position = data.body_pos_w[:, bodies] - data.root_pos_w[:, None]
    quat = data.root_quat_w[:, None].expand(-1, position.shape[1], -1)
    parts = [
        rotate_inverse(quat, position),
        multiply(conjugate(quat), data.body_quat_w[:, bodies]),
        rotate_inverse(quat, data.body_lin_vel_w[:, bodies]),
        rotate_inverse(quat, data.body_ang_vel_w[:, bodies]),
    ]
    return torch.cat(parts, dim=2).flatten(1)


@reads_body_forces
def body_incoming_wrench(env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies = ".*") -> Tensor:
    """Force and torque of the parent on each body, at the body's origin, in the body's frame [N, N m]. (num_envs, 6 k)

    Values of the last substep. Isaac Lab: `body_incoming_wrench`.
    """
    return entity.data.body_incoming_wrench_b[:, bodies].flatten(1)


def last_action(env: ManagedEnv) -> Tensor:
    """Last action of the policy, before scaling; zero at the start of an episode. (num_envs, a)"""
    return env.action_manager.action


def generated_commands(env: ManagedEnv, *, command: Command, columns: list[int] | None = None) -> Tensor:
    """Command of a term of `commands:`, or some of its columns. (num_envs, k)"""
    return _columns_of(command.command, columns)


def body_to_goal(
    env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, command: Command, columns: list[int] | None = None
) -> Tensor:
    """Vector from a body to the goal of a pose command, in the frame of the root of `entity` [m]. (num_envs, k)"""
    offset = goal_in_world(entity, command) - single(entity.data.body_pos_w[:, bodies], "body")
    return _columns_of(rotate_inverse(entity.data.root_quat_w, offset), columns)


def current_time_s(env: ManagedEnv) -> Tensor:
    """Time since the start of the episode [s]. (num_envs, 1)"""
    return env.episode_length_buf[:, None] * env.step_dt


def remaining_time_s(env: ManagedEnv) -> Tensor:
    """Time until the time-out of the episode [s]. (num_envs, 1)"""
    return (env.max_episode_length - env.episode_length_buf)[:, None] * env.step_dt


def sensor_data(env: ManagedEnv, *, entity: Entity = "robot", sensors: Sensors) -> Tensor:
    """Sensor readings, one after the other, each in its own unit, of sensors in the MJCF. (num_envs, k)

    Forces and accelerations belong to the last substep (physics step). mjlab: `builtin_sensor`.
    """
    return entity.data.sensordata[:, sensors]


def imu_orientation(env: ManagedEnv, *, entity: Entity = "robot", sensors: Sensors) -> Tensor:
    """Orientation of a `framequat` sensor in the MJCF, quaternion (w, x, y, z), world frame. (num_envs, 4)"""
    return _reading(entity, sensors, 4, "framequat")


def imu_projected_gravity(env: ManagedEnv, *, entity: Entity = "robot", sensors: Sensors) -> Tensor:
    """Direction of gravity in the frame of a `framequat` sensor in the MJCF, a unit vector. (num_envs, 3)"""
    return rotate_inverse(_reading(entity, sensors, 4, "framequat"), entity.data.down_w)


def imu_ang_vel(env: ManagedEnv, *, entity: Entity = "robot", sensors: Sensors) -> Tensor:
    """Angular velocity of a `gyro` sensor in the MJCF, in its own frame [rad/s]. (num_envs, 3)"""
    return _reading(entity, sensors, 3, "gyro")


def imu_lin_acc(env: ManagedEnv, *, entity: Entity = "robot", sensors: Sensors) -> Tensor:
    """Acceleration of an `accelerometer` sensor in the MJCF, in its own frame [m/s^2]. (num_envs, 3)

    Value of the last substep. Like a real accelerometer, the sensor reads g upwards at rest, and 0 in free fall.
    """
    return _reading(entity, sensors, 3, "accelerometer")


def height_scan(env: ManagedEnv, *, sensor: RaySensor, offset: float = 0.5) -> Tensor:
    """Height of the sensor above the point that each ray hits, minus `offset` [m]. (num_envs, r)

    A ray without a hit counts as a hit at its full length. Isaac Lab: such a ray has an infinite value.
    """
    return sensor.position[:, 2:3] - sensor.hits[:, :, 2] - offset


def image(env: ManagedEnv, *, sensor: CameraSensor, normalize: bool = True) -> Tensor:
    """Image of a camera, rows from the top: colours, distances [m] or ids of bodies. (num_envs, c, h, w)

    A distance is 0 where nothing is visible. Colours are 0 to 255; with `normalize` they are divided by 255, and the
    mean of each channel of the image is subtracted. Isaac Lab: channels last.
    """
    image = sensor.image.movedim(-1, 1).float().contiguous()
    if sensor.config.data != "rgb" or not normalize:
        return image
    image = image / 255.0
    return image - image.flatten(2).mean(dim=2)[:, :, None, None]


def foot_height(env: ManagedEnv, *, entity: Entity = "robot", sites: Sites) -> Tensor:
    """Heights of sites above their environment's origin [m]. (num_envs, k)  mjlab: `foot_height`."""
    return entity.data.site_pos_w[:, sites, 2] - env.origins[:, 2:3]


def foot_air_time(env: ManagedEnv, *, sensor: ContactSensor) -> Tensor:
    """Time since each body of the sensor left the ground; 0 in contact [s]. (num_envs, k)  mjlab: `foot_air_time`."""
    return sensor.air_time


def foot_contact(env: ManagedEnv, *, sensor: ContactSensor) -> Tensor:
    """1 for each body of the sensor that is in contact, else 0. (num_envs, k)  mjlab: `foot_contact`."""
    return sensor.found.float()


def foot_contact_forces(env: ManagedEnv, *, sensor: ContactSensor) -> Tensor:
    """Contact forces F in N, compressed to sign(F) log(1 + |F|), world frame. (num_envs, 3 k)

    mjlab: `foot_contact_forces`.
    """
    force = sensor.force.flatten(1)
    return force.sign() * force.abs().log1p_()


def fingers_contact_force_b(env: ManagedEnv, *, entity: Entity = "robot", sensor: ContactSensor) -> Tensor:
    """Contact forces on the bodies of the sensor, in the root's frame [N]. (num_envs, 3 k)"""
    quat = entity.data.root_quat_w[:, None].expand(-1, sensor.force.shape[1], -1)
    return rotate_inverse(quat, sensor.force).flatten(1)


def ee_pos(env: ManagedEnv, *, entity: Entity = "robot", sites: Sites) -> Tensor:
    """Positions of sites from the environment's origin, world frame [m]. (num_envs, 3 k)

    Isaac Lab: `ee_frame_pos`.
    """
    return (entity.data.site_pos_w[:, sites] - env.origins[:, None]).flatten(1)


def ee_quat(env: ManagedEnv, *, entity: Entity = "robot", sites: Sites, make_quat_unique: bool = True) -> Tensor:
    """Orientations of sites, quaternions (w, x, y, z), world frame. (num_envs, 4 k)

    make_quat_unique: use the quaternions with w >= 0.
    """
    quat = entity.data.site_quat_w[:, sites]
    return (unique(quat) if make_quat_unique else quat).flatten(1)


def ee_velocity(env: ManagedEnv, *, entity: Entity = "robot", sites: Sites) -> Tensor:
    """Velocities of sites, in the root's frame [m/s]. (num_envs, 3 k)  mjlab: `ee_velocity`."""
    velocity = entity.data.site_lin_vel_w[:, sites]
    return rotate_inverse(entity.data.root_quat_w[:, None].expand(-1, velocity.shape[1], -1), velocity).flatten(1)


def object_position_in_robot_root_frame(
    env: ManagedEnv, *, entity: Entity = "robot", object: Entity = "object"
) -> Tensor:
    """Position of an object relative to the root of `entity`, in the frame of this root [m]. (num_envs, 3)

    Isaac Lab: also `object_pos_b`.
    """
    return rotate_inverse(entity.data.root_quat_w, object.data.root_pos_w - entity.data.root_pos_w)


def object_quat_b(env: ManagedEnv, *, entity: Entity = "robot", object: Entity = "object") -> Tensor:
    """Orientation of an object relative to the root of `entity`, quaternion (w, x, y, z). (num_envs, 4)"""
    return multiply(conjugate(entity.data.root_quat_w), object.data.root_quat_w)


def rel_ee_object_distance(
    env: ManagedEnv, *, entity: Entity = "robot", sites: Sites, object: Entity = "object"
) -> Tensor:
    """Vector from a site of `entity` to the root of an object, world frame [m]. (num_envs, 3)"""
    return object.data.root_pos_w - single(entity.data.site_pos_w[:, sites], "site")


def ee_to_object_distance(
    env: ManagedEnv, *, entity: Entity = "robot", sites: Sites, object: Entity = "object"
) -> Tensor:
    """Vector from a site of `entity` to the root of an object, in the frame of the root of `entity` [m]. (num_envs, 3)

    mjlab: `ee_to_object_distance`.
    """
    offset = rel_ee_object_distance(env, entity=entity, sites=sites, object=object)
    return rotate_inverse(entity.data.root_quat_w, offset)


class RelEeDrawerDistance(HandleTerm):
    """Vector from a site of `entity` to the site `handle` of `cabinet`, world frame [m]. (num_envs, 3)"""

    def __call__(self) -> Tensor:
        """Return the vector from the site to the handle, world frame [m]. (num_envs, 3)"""
        return self.offset_to_handle()


def object_to_goal_distance(
    env: ManagedEnv, *, entity: Entity = "robot", object: Entity = "object", command: Command
) -> Tensor:
    """Vector from an object to the goal of a pose command, in the frame of the root of `entity` [m]. (num_envs, 3)

    mjlab: `object_to_goal_distance`.
    """
    return command.command[:, :3] - object_position_in_robot_root_frame(env, entity=entity, object=object)


def goal_quat_diff(
    env: ManagedEnv, *, object: Entity = "object", command: Command, make_quat_unique: bool = False
) -> Tensor:
    """Rotation from the goal's orientation to the object's, quaternion (w, x, y, z), world frame. (num_envs, 4)

    The goal is in columns 3 to 6 of the command, world frame. make_quat_unique: use the quaternion with w >= 0.
    """
    quat = multiply(object.data.root_quat_w, conjugate(command.command[:, 3:7]))
    return unique(quat) if make_quat_unique else quat


def _columns_of(value: Tensor, columns: list[int] | None) -> Tensor:
    if columns is None:
        return value
    if not columns or not all(0 <= column < value.shape[1] for column in columns):
        raise ValueError(f"`columns` is {columns}; give one or more of 0 to {value.shape[1] - 1}, or null for all")
    return torch.stack([value[:, column] for column in columns], dim=1)


def _offset_xy(env: ManagedEnv, entity: Entity, target: tuple[float, float, float]) -> Tensor:
    """Return the horizontal vector from the root to a point from the environment's origin [m]. (num_envs, 2)"""
    return constant(target, env.device)[:2] + env.origins[:, :2] - entity.data.root_pos_w[:, :2]


def _reading(entity: Entity, sensors: Sensors, size: int, kind: str) -> Tensor:
    values = entity.data.sensordata[:, sensors]
    if values.shape[1] != size:
        found = f"`sensors` selects {values.shape[1]} columns of sensor data"
        raise ValueError(f"{found}; select one {kind} sensor, which has {size} columns")
    return values
