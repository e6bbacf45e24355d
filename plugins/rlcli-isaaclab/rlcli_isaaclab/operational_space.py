"""Operational space control: joint efforts that move a frame of a body to a pose, or push with a force and torque."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rlcli.errors import TaskError
from rlcli.sim.rotations import conjugate, rotate, rotate_inverse
from rlcli_isaaclab.managers import ActionTerm
from rlcli_isaaclab.utils.math import (
    apply_delta_pose,
    combine_frame_transforms,
    compute_pose_error,
    matrix_from_quat,
    skew_symmetric_matrix,
    subtract_frame_transforms,
)

_TARGETS = {"pose_abs": 7, "pose_rel": 6, "wrench_abs": 6}
"""Kind of target -> number of columns."""
_GAINS = {"fixed": 0, "variable_kp": 6, "variable": 12}
"""Impedance mode -> number of the command's columns that are gains."""


class OperationalSpaceController:
    """Controller of the pose and the contact wrench of a frame.

    States and efforts are in the frame of the robot's root, targets and gains in the task frame.

    Commanded force (Khatib 1987): F = Lambda (Kp e - Kd v), with e the pose error, v the frame's velocity, Kd = 2
    sqrt(Kp) x damping ratio and Lambda = (J M^-1 J^T)^-1 with inertial decoupling, else 1. Efforts: J^T S F, with S the
    controlled axes, plus the wrench's efforts, gravity and the null space.
    """

    def __init__(self, cfg: Any, num_envs: int, device: Any) -> None:
        self.cfg, self.num_envs, self._device = cfg, num_envs, device
        unknown = [kind for kind in cfg.target_types if kind not in _TARGETS]
        if unknown or cfg.impedance_mode not in _GAINS or cfg.nullspace_control not in ("none", "position"):
            raise ValueError(
                f"target_types are {', '.join(_TARGETS)}, impedance_mode {', '.join(_GAINS)}, and nullspace_control"
                f" none or position; found {list(cfg.target_types)}, {cfg.impedance_mode}, {cfg.nullspace_control}"
            )
        self.target_list = [_TARGETS[kind] for kind in cfg.target_types]
        self.target_dim = sum(self.target_list)
        self._motion_axes = self._row(cfg.motion_control_axes_task)
        self._wrench_axes = self._row(cfg.contact_wrench_control_axes_task)
        self._kp = self._row(cfg.motion_stiffness_task) * self._motion_axes
        self._ratio = self._row(cfg.motion_damping_ratio_task)
        wrench_gain = cfg.contact_wrench_stiffness_task
        self._wrench_gain = None if wrench_gain is None else self._row(wrench_gain) * self._wrench_axes
        self._frame = torch.eye(3, device=device).expand(num_envs, 3, 3)
        self.desired_ee_pose_b: Tensor | None = None
        self.desired_ee_wrench_b: Tensor | None = None

    def _row(self, value: Any) -> Tensor:
        """Return a setting (one number, or one for each axis) as a row for each environment. (num_envs, 6)"""
        row = torch.as_tensor(value, dtype=torch.float32, device=self._device).expand(6)
        return row.expand(self.num_envs, 6).clone()

    @property
    def action_dim(self) -> int:
        """Number of columns of a command."""
        return self.target_dim + _GAINS[self.cfg.impedance_mode]

    def reset(self) -> None:
        """Remove the targets of the last command."""
        self.desired_ee_pose_b = self.desired_ee_wrench_b = None

    def set_command(
        self,
        command: Tensor,
        current_ee_pose_b: Tensor | None = None,
        current_task_frame_pose_b: Tensor | None = None,
    ) -> None:
        """Set the targets and gains of the controller from a command.

        Args:
            command: targets in the order of `target_types`, then stiffnesses and damping ratios if the impedance mode
                has them. (num_envs, action_dim)
            current_ee_pose_b: present pose of the controlled frame, root frame. (num_envs, 7) [m, (w, x, y, z)]
            current_task_frame_pose_b: pose of the frame in which targets are given, root frame; None: the root frame.

        Raises:
            ValueError: if the command has another shape, or a relative target has no present pose.
        """
        if command.shape != (self.num_envs, self.action_dim):
            raise ValueError(f"a command has shape {tuple(command.shape)}; pass {(self.num_envs, self.action_dim)}")
        if self.cfg.impedance_mode != "fixed":
            low, high = self.cfg.motion_stiffness_limits_task
            self._kp = command[:, self.target_dim : self.target_dim + 6].clamp(low, high) * self._motion_axes
        if self.cfg.impedance_mode == "variable":
            low, high = self.cfg.motion_damping_ratio_limits_task
            self._ratio = command[:, self.target_dim + 6 :].clamp(low, high)
        frame = current_task_frame_pose_b
        if frame is None:
            frame = torch.tensor([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], device=self._device).expand(self.num_envs, 7)
        self._frame = matrix_from_quat(frame[:, 3:])
        targets = torch.split(command[:, : self.target_dim], self.target_list, dim=1)
        for kind, target in zip(self.cfg.target_types, targets, strict=True):
            if kind == "wrench_abs":
                force = rotate(frame[:, 3:], target[:, :3])
                torque = rotate(frame[:, 3:], target[:, 3:]) + torch.linalg.cross(frame[:, :3], force)
                self.desired_ee_wrench_b = torch.cat([force, torque], dim=1)
                continue
            position, quat = target[:, :3], target[:, 3:]
            if kind == "pose_rel":
                if current_ee_pose_b is None:
                    raise ValueError("a pose_rel command needs the current pose; pass current_ee_pose_b")
                now = subtract_frame_transforms(
                    frame[:, :3], frame[:, 3:], current_ee_pose_b[:, :3], current_ee_pose_b[:, 3:]
                )
                position, quat = apply_delta_pose(*now, target)
            self.desired_ee_pose_b = torch.cat(
                combine_frame_transforms(frame[:, :3], frame[:, 3:], position, quat), dim=1
            )

    def compute(
        self,
        jacobian_b: Tensor,
        current_ee_pose_b: Tensor | None = None,
        current_ee_vel_b: Tensor | None = None,
        current_ee_force_b: Tensor | None = None,
        mass_matrix: Tensor | None = None,
        gravity: Tensor | None = None,
        current_joint_pos: Tensor | None = None,
        current_joint_vel: Tensor | None = None,
        nullspace_joint_pos_target: Tensor | None = None,
    ) -> Tensor:
        """Return the efforts of the k joints, from the Jacobian of the controlled frame and the present state.

        All vectors are in the root's frame. jacobian_b (num_envs, 6, k) -> (num_envs, k) [N or N m]

        Raises:
            ValueError: if an argument that the settings of the controller need is None.
        """
        efforts = torch.zeros(self.num_envs, jacobian_b.shape[2], device=self._device)
        inverse = inertia = None
        if self.cfg.inertial_dynamics_decoupling:
            inverse = torch.linalg.inv(_given(mass_matrix, "mass_matrix"))
            inertia = self._inertia(jacobian_b, inverse)
        if self.desired_ee_pose_b is not None:
            pose, velocity = (
                _given(current_ee_pose_b, "current_ee_pose_b"),
                _given(current_ee_vel_b, "current_ee_vel_b"),
            )
            goal = self.desired_ee_pose_b
            error = torch.cat(compute_pose_error(pose[:, :3], pose[:, 3:], goal[:, :3], goal[:, 3:]), dim=1)
            damping = 2.0 * self._kp.sqrt() * self._ratio
            force = self._along_axes(self._kp, error) - self._along_axes(damping, velocity)
            if inertia is not None:
                force = (inertia @ force[:, :, None])[:, :, 0]
            force = self._along_axes(self._motion_axes, force)
            efforts += (jacobian_b.mT @ force[:, :, None])[:, :, 0]
        if self.desired_ee_wrench_b is not None:
            wrench = self.desired_ee_wrench_b
            if self._wrench_gain is not None:
                force = _given(current_ee_force_b, "current_ee_force_b")
                # only forces are measured, so the torques are controlled without feedback
                missing = torch.cat([wrench[:, :3] - force, torch.zeros_like(force)], dim=1)
                wrench = wrench + self._along_axes(self._wrench_gain, missing)
            wrench = self._along_axes(self._wrench_axes, wrench)
            efforts += (jacobian_b.mT @ wrench[:, :, None])[:, :, 0]
        if self.cfg.gravity_compensation:
            efforts += _given(gravity, "gravity")
        if self.cfg.nullspace_control == "position":
            position, velocity = (
                _given(current_joint_pos, "current_joint_pos"), _given(current_joint_vel, "current_joint_vel"),
            )  # fmt: skip
            target = torch.zeros_like(position) if nullspace_joint_pos_target is None else nullspace_joint_pos_target
            stiffness = self.cfg.nullspace_stiffness
            damping_gain = 2.0 * stiffness**0.5 * self.cfg.nullspace_damping_ratio
            wanted = (stiffness * (target - position) - damping_gain * velocity)[:, :, None]
            wanted = wanted if mass_matrix is None else mass_matrix @ wanted
            efforts += (self._null_space(jacobian_b, inverse, inertia) @ wanted)[:, :, 0]
        return efforts

    def _along_axes(self, gains: Tensor, values: Tensor) -> Tensor:
        """Multiply linear and angular parts by gains along the axes of the task frame. (num_envs, 6) each"""
        parts = []
        for part in (slice(0, 3), slice(3, 6)):
            local = (self._frame.mT @ values[:, part, None])[:, :, 0]
            parts.append((self._frame @ (gains[:, part] * local)[:, :, None])[:, :, 0])
        return torch.cat(parts, dim=1)

    def _inertia(self, jacobian: Tensor, inverse: Tensor) -> Tensor:
        """Return the inertia in operational space, with or without coupling of translation and rotation. (n, 6, 6)"""
        if not self.cfg.partial_inertial_dynamics_decoupling:
            return torch.linalg.inv(jacobian @ inverse @ jacobian.mT)
        blocks = torch.zeros(self.num_envs, 6, 6, device=self._device)
        for part in (slice(0, 3), slice(3, 6)):
            blocks[:, part, part] = torch.linalg.inv(jacobian[:, part] @ inverse @ jacobian[:, part].mT)
        return blocks

    def _null_space(self, jacobian: Tensor, inverse: Tensor | None, inertia: Tensor | None) -> Tensor:
        """Return the projector of efforts that do not move the frame. (num_envs, k, k)"""
        count = jacobian.shape[2]
        if count <= 6:
            raise ValueError(f"nullspace_control needs more than 6 joints; the action has {count}")
        if inverse is None or inertia is None or self.cfg.partial_inertial_dynamics_decoupling:
            back = torch.linalg.pinv(jacobian).mT
        else:
            back = inertia @ jacobian @ inverse
        return torch.eye(count, device=self._device) - jacobian.mT @ back


class OperationalSpaceControllerAction(ActionTerm):
    """Action that sets targets of an `OperationalSpaceController`, which computes efforts in every physics step."""

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(cfg, env)
        if cfg.task_frame_rel_path is not None:
            raise TaskError(
                "OperationalSpaceControllerActionCfg.task_frame_rel_path cannot be used: rlcli controls in the root's"
                " frame", hint="remove task_frame_rel_path",
            )  # fmt: skip
        asset, control = self._asset, cfg.controller_cfg
        if asset.data._entity.is_floating:
            raise TaskError("operational space control needs a fixed base", hint=f"fix the base of '{cfg.asset_name}'")
        self._joint_ids, _ = asset.find_joints(cfg.joint_names)
        bodies, _ = asset.find_bodies(cfg.body_name)
        self._body = bodies[0]
        self._osc = OperationalSpaceController(control, self.num_envs, self.device)
        self._raw_actions = torch.zeros(self.num_envs, self.action_dim, device=self.device)
        self._processed_actions = torch.zeros_like(self._raw_actions)
        self._factors = self._scales()
        offset = cfg.body_offset
        place = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)) if offset is None else (offset.pos, offset.rot)
        self._offset_pos, self._offset_rot = (
            torch.tensor(values, device=self.device).expand(self.num_envs, -1) for values in place
        )
        closed_loop = control.contact_wrench_stiffness_task is not None
        self._force_sensor = next(
            (s for s in env.scene.sensors.values() if closed_loop and cfg.body_name in getattr(s, "body_names", [])),
            None,
        )
        if closed_loop and self._force_sensor is None:
            raise TaskError(f"no contact sensor measures '{cfg.body_name}'", hint="add a ContactSensorCfg for it")
        self._rest = self._null_space_target()

    def _scales(self) -> Tensor:
        """Return the factor of each column. (action_dim,)"""
        cfg, factors = self.cfg, []
        for kind, size in zip(cfg.controller_cfg.target_types, self._osc.target_list, strict=True):
            turn = cfg.wrench_scale if kind == "wrench_abs" else cfg.orientation_scale
            move = cfg.wrench_scale if kind == "wrench_abs" else cfg.position_scale
            factors += [move] * 3 + [turn] * (size - 3)
        gains = [cfg.stiffness_scale] * 6 + [cfg.damping_ratio_scale] * 6
        factors += gains[: self.action_dim - len(factors)]
        return torch.tensor(factors, device=self.device)

    def _null_space_target(self) -> Tensor | None:
        name, data = self.cfg.nullspace_joint_pos_target, self._asset.data
        is_controlled = self.cfg.controller_cfg.nullspace_control == "position"
        if name not in ("none", "zero", "center", "default") or (name != "none") != is_controlled:
            raise ValueError(
                f"nullspace_joint_pos_target is '{name}'; write zero, center or default with nullspace_control"
                " position, and none without"
            )
        if name == "center":
            return data.soft_joint_pos_limits[:, self._joint_ids].mean(dim=-1)
        return data.default_joint_pos[:, self._joint_ids] if name == "default" else None

    @property
    def action_dim(self) -> int:
        """Number of columns of the policy's action."""
        return self._osc.action_dim

    @property
    def raw_actions(self) -> Tensor:
        """The policy's action for this term. (num_envs, k)"""
        return self._raw_actions

    @property
    def processed_actions(self) -> Tensor:
        """The scaled action. (num_envs, k)"""
        return self._processed_actions

    def process_actions(self, actions: Tensor) -> None:
        """Scale the policy's action, and set it as the command of the controller. (num_envs, k)"""
        self._raw_actions[:] = actions
        self._processed_actions[:] = actions * self._factors
        self._osc.set_command(self._processed_actions, self._ee_pose()[0])

    def apply_actions(self) -> None:
        """Compute the joint efforts of the next physics step, and set them as targets of the joints."""
        data, view = self._asset.data, self._asset.root_physx_view
        root = data.root_quat_w
        pose, body = self._ee_pose()
        velocity = data.body_vel_w[:, self._body] - data.root_vel_w
        linear, angular = rotate_inverse(root, velocity[:, :3]), rotate_inverse(root, velocity[:, 3:])
        linear = linear + torch.linalg.cross(angular, rotate(body, self._offset_pos))
        jacobian = view.get_jacobians()[:, self._body - 1][:, :, self._joint_ids]
        turn = matrix_from_quat(conjugate(root))
        moves, turns = turn @ jacobian[:, :3], turn @ jacobian[:, 3:]
        # as in Isaac Lab, the offset is applied to the Jacobian in the body's frame, and the rotation of the offset
        # before that of the root
        moves = moves - skew_symmetric_matrix(self._offset_pos) @ turns
        turns = matrix_from_quat(self._offset_rot) @ turns
        force = None
        if self._force_sensor is not None:
            measured = self._force_sensor.data.net_forces_w[:, self._force_sensor.body_names.index(self.cfg.body_name)]
            force = rotate_inverse(root, measured)
        efforts = self._osc.compute(
            jacobian_b=torch.cat([moves, turns], dim=1),
            current_ee_pose_b=pose,
            current_ee_vel_b=torch.cat([linear, angular], dim=1),
            current_ee_force_b=force,
            mass_matrix=view.get_generalized_mass_matrices()[:, self._joint_ids][:, :, self._joint_ids],
            gravity=view.get_gravity_compensation_forces()[:, self._joint_ids],
            current_joint_pos=data.joint_pos[:, self._joint_ids],
            current_joint_vel=data.joint_vel[:, self._joint_ids],
            nullspace_joint_pos_target=self._rest,
        )
        self._asset.set_joint_effort_target(efforts, joint_ids=self._joint_ids)

    def _ee_pose(self) -> tuple[Tensor, Tensor]:
        """Return the pose of the controlled frame, and the body's quaternion, root frame. (num_envs, 7), (n, 4)"""
        data = self._asset.data
        position, quat = subtract_frame_transforms(
            data.root_pos_w, data.root_quat_w, data.body_pos_w[:, self._body], data.body_quat_w[:, self._body]
        )
        pose = combine_frame_transforms(position, quat, self._offset_pos, self._offset_rot)
        return torch.cat(pose, dim=1), quat

    def reset(self, env_ids: Any = None) -> None:
        """Set the raw actions of the environments `env_ids` to zero; None: of all environments."""
        self._raw_actions[slice(None) if env_ids is None else env_ids] = 0.0


def _given(value: Tensor | None, name: str) -> Tensor:
    if value is None:
        raise ValueError(f"the controller needs {name}; pass it to compute()")
    return value
