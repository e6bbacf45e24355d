"""Configuration of differential inverse kinematics, and a stand-in for a function of Pink (another IK library).

A task of Isaac Lab that imports a name from `isaaclab.controllers` gets the object of this name from here.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rlcli.errors import TaskError, listing
from rlcli_isaaclab.config_class import MISSING, configclass
from rlcli_isaaclab.missing_names import user_place
from rlcli_isaaclab.operational_space import OperationalSpaceController
from rlcli_isaaclab.utils.math import apply_delta_pose, compute_pose_error


@configclass
class DifferentialIKControllerCfg:
    """Settings of differential inverse kinematics; rlcli's own action term always uses damped least squares."""

    class_type: Any = "DifferentialIKController"
    command_type: str = MISSING
    use_relative_mode: bool = False
    ik_method: str = "dls"
    ik_params: Any = None


class DifferentialIKController:
    """Controller that computes joint positions for a position or pose of a body, for a task's own actions."""

    def __init__(self, cfg: Any, num_envs: int, device: Any) -> None:
        if cfg.command_type not in ("position", "pose") or cfg.ik_method not in _DEFAULTS:
            raise TaskError(
                f"{user_place()}DifferentialIKControllerCfg: unknown command_type '{cfg.command_type}' or ik_method"
                f" '{cfg.ik_method}'",
                hint=f"use position or pose, and {listing(_DEFAULTS)}",
            )
        self.cfg, self.num_envs, self._device = cfg, num_envs, device
        self._params = {**_DEFAULTS[cfg.ik_method], **(cfg.ik_params or {})}
        self.ee_pos_des, self.ee_quat_des = (
            torch.zeros(num_envs, 3, device=device),
            torch.zeros(num_envs, 4, device=device),
        )
        self._command = torch.zeros(num_envs, self.action_dim, device=device)

    @property
    def action_dim(self) -> int:
        """Number of columns of a command."""
        if self.cfg.command_type == "position":
            return 3
        return 6 if self.cfg.use_relative_mode else 7

    def reset(self, env_ids: Any = None) -> None:
        """Do nothing: each command replaces the one before."""

    def set_command(self, command: Tensor, ee_pos: Tensor | None = None, ee_quat: Tensor | None = None) -> None:
        """Set the wanted pose, or its difference from the present pose of the body. (num_envs, action_dim)"""
        self._command[:] = command
        is_relative, is_position = self.cfg.use_relative_mode, self.cfg.command_type == "position"
        if not is_relative and not is_position:
            self.ee_pos_des, self.ee_quat_des = self._command[:, :3], self._command[:, 3:]
            return
        if ee_quat is None or (is_relative and ee_pos is None):
            raise ValueError("set_command of a relative command or a position needs the present pose of the body")
        if is_position:
            self.ee_pos_des = self._command.clone() if ee_pos is None or not is_relative else self._command + ee_pos
            self.ee_quat_des = ee_quat.clone()
        elif ee_pos is not None:
            self.ee_pos_des, self.ee_quat_des = apply_delta_pose(ee_pos, ee_quat, self._command)

    def compute(self, ee_pos: Tensor, ee_quat: Tensor, jacobian: Tensor, joint_pos: Tensor) -> Tensor:
        """Return the joint positions for the command.

        Args:
            ee_pos: present position of the body. (num_envs, 3) [m]
            ee_quat: present orientation of the body. (num_envs, 4)
            jacobian: Jacobian of the body, in the frame of the pose. (num_envs, 6, joints)
            joint_pos: present joint positions. (num_envs, joints) [m or rad]
        """
        error, turn = compute_pose_error(ee_pos, ee_quat, self.ee_pos_des, self.ee_quat_des, "axis_angle")
        if self.cfg.command_type == "position":
            jacobian = jacobian[:, :3]
        else:
            error = torch.cat([error, turn], dim=1)
        return joint_pos + (self._inverse(jacobian) @ error.unsqueeze(-1)).squeeze(-1)

    def _inverse(self, jacobian: Tensor) -> Tensor:
        """Return the matrix from an error of the pose to changes of the joints. (num_envs, joints, 3 or 6)"""
        method, params = self.cfg.ik_method, self._params
        if method == "dls":
            square = jacobian @ jacobian.mT + params["lambda_val"] ** 2 * torch.eye(
                jacobian.shape[1], device=self._device
            )
            return torch.linalg.solve(square, jacobian).mT
        if method == "trans":
            return params["k_val"] * jacobian.mT
        if method == "pinv":
            return params["k_val"] * torch.linalg.pinv(jacobian)
        u, values, vh = torch.linalg.svd(jacobian, full_matrices=False)
        inverse = torch.where(values > params["min_singular_value"], 1.0 / values, torch.zeros_like(values))
        return params["k_val"] * (vh.mT @ (inverse.unsqueeze(-1) * u.mT))


_DEFAULTS = {
    "pinv": {"k_val": 1.0},
    "svd": {"k_val": 1.0, "min_singular_value": 1e-5},
    "trans": {"k_val": 1.0},
    "dls": {"lambda_val": 0.01},
}
"""Method of the inverse kinematics -> its parameters."""


def convert_usd_to_urdf(usd_path: str, output_path: str, force_conversion: bool = True) -> tuple[str, str]:
    """Return the paths that Isaac Lab would write, without writing: only Pink, which rlcli lacks, reads the files."""
    return f"{output_path}/urdf", f"{output_path}/meshes"


__all__ = [
    "DifferentialIKController",
    "DifferentialIKControllerCfg",
    "OperationalSpaceController",
    "convert_usd_to_urdf",
]
