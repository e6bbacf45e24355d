"""Observation terms. (num_envs, k) each."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from rlcli.task import Entity, Joints

if TYPE_CHECKING:
    from rlcli.envs.managed import ManagedEnv


def joint_pos(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Joint positions [m or rad]. (num_envs, k)"""
    return entity.data.joint_pos[:, joints]


def joint_vel(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Joint velocities [m/s or rad/s]. (num_envs, k)"""
    return entity.data.joint_vel[:, joints]


def joint_pos_rel(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Joint positions less their defaults [m or rad]. (num_envs, k)"""
    return entity.data.joint_pos[:, joints] - entity.data.default_joint_pos[:, joints]


def joint_vel_rel(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Joint velocities less their defaults [m/s or rad/s]. (num_envs, k)"""
    return entity.data.joint_vel[:, joints] - entity.data.default_joint_vel[:, joints]


def base_pos_z(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Height of the root [m]. (num_envs, 1)"""
    return entity.data.root_pos_w[:, 2:3]


def base_lin_vel(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Linear velocity of the root in its own frame [m/s]. (num_envs, 3)"""
    return entity.data.root_lin_vel_b


def base_ang_vel(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Angular velocity of the root in its own frame [rad/s]. (num_envs, 3)"""
    return entity.data.root_ang_vel_b


def projected_gravity(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Direction of gravity in the root's frame, length 1. (num_envs, 3)"""
    return entity.data.projected_gravity_b


def last_action(env: ManagedEnv) -> Tensor:
    """The policy's last action, before scaling; zero at the start of an episode. (num_envs, a)"""
    return env.action_manager.action
