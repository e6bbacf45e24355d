"""Own implementations of terms of Isaac Lab, for which rlcli has no built-in term with equal results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from rlcli_isaaclab.managers import ManagerTermBase
from rlcli_isaaclab.utils.math import quat_apply_inverse, sample_uniform


@dataclass(frozen=True, slots=True)
class LabTerm:
    """Implementation of a term of Isaac Lab, and the parameters for which it is used."""

    function: Any
    needed: Callable[[Mapping[str, Any]], bool]
    """Function that returns whether `function` is used for these parameters; else rlcli's built-in term is."""


def last_action_of_term(env: Any, action_name: str) -> Tensor:
    """Last action of the policy for one action term, before scaling. (num_envs, k)"""
    return env.action_manager.get_term(action_name).raw_actions


def action_l2_clamped(env: Any) -> Tensor:
    """Sum of the squared actions, at most 1000. (num_envs,)"""
    return env.action_manager.action.square().sum(dim=1).clamp(-1000.0, 1000.0)


def action_rate_l2_clamped(env: Any) -> Tensor:
    """Sum of the squared changes of the actions, at most 1000. (num_envs,)"""
    manager = env.action_manager
    return (manager.action - manager.prev_action).square().sum(dim=1).clamp(-1000.0, 1000.0)


def fingers_contact_force_b(env: Any, contact_sensor_names: list[str], asset_cfg: Any = None) -> Tensor:
    """Return the contact forces that the named sensors measure, robot's root frame. (num_envs, 3 k) [N]

    A sensor with filters counts only contacts with the objects that its filters name.
    """
    robot = env.scene["robot" if asset_cfg is None else asset_cfg.name]
    data = [env.scene.sensors[name].data for name in contact_sensor_names]
    forces = [d.net_forces_w if d.force_matrix_w is None else d.force_matrix_w.sum(dim=2) for d in data]
    force = torch.cat(forces, dim=1)
    return quat_apply_inverse(robot.data.root_link_quat_w[:, None].expand(-1, force.shape[1], -1), force).flatten(1)


def command_resample(env: Any, command_name: str, num_resamples: int = 1) -> Tensor:
    """Whether a command that was sampled `num_resamples` times in the episode is about to be resampled. (num_envs,)"""
    command = env.command_manager.get_term(command_name)
    return (command.time_left < 1.5 * env.step_dt) & (command.command_counter == num_resamples)


class reset_joints_within_limits_range(ManagerTermBase):  # noqa: N801  (Isaac Lab's name)
    """Event that samples joint positions and velocities from a range of each joint, or within its soft limits."""

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(cfg, env)
        params = cfg.params
        self._asset = env.scene[getattr(params.get("asset_cfg"), "name", "robot")]
        data, speed = self._asset.data, self._asset.data.soft_joint_vel_limits[0]
        self._limits = data.soft_joint_pos_limits[0]
        ends = {"position_range": self._limits, "velocity_range": torch.stack([-speed, speed], dim=1)}
        defaults = {"position_range": data.default_joint_pos[0], "velocity_range": data.default_joint_vel[0]}
        self._ranges: dict[str, tuple[list[int], Tensor]] = {}
        for key, limits in ends.items():
            ranges, chosen = limits.clone(), []
            for pattern, pair in params[key].items():
                joints = self._asset.find_joints(pattern)[0]
                for end, value in enumerate(pair):
                    if value is not None:
                        scale = params.get("operation", "abs") == "scale"
                        ranges[joints, end] = value * ranges[joints, end] if scale else value
                if params.get("use_default_offset", False):
                    ranges[joints] += defaults[key][joints, None]
                chosen += joints
            self._ranges[key] = chosen, ranges[chosen]

    def __call__(
        self, env: Any, env_ids: Tensor, position_range: Any, velocity_range: Any, use_default_offset: bool = False,
        asset_cfg: Any = None, operation: str = "abs",
    ) -> None:  # fmt: skip
        """Sample positions and velocities of joints in the environments `env_ids`.

        `__init__` has read the ranges; the arguments after `env_ids` are not read here.
        """
        data = self._asset.data
        state = {"position_range": data.default_joint_pos, "velocity_range": data.default_joint_vel}
        for key, (joints, ranges) in self._ranges.items():
            values = state[key][env_ids].clone()
            shape = (len(env_ids), len(joints))
            values[:, joints] = sample_uniform(ranges[:, 0], ranges[:, 1], shape, env.device)
            state[key] = values
        position = state["position_range"].clamp(self._limits[:, 0], self._limits[:, 1])
        self._asset.write_joint_state_to_sim(position, state["velocity_range"], None, env_ids)


def _always(params: Mapping[str, Any]) -> bool:
    return True


LAB_TERMS: dict[str, LabTerm] = {
    "last_action": LabTerm(last_action_of_term, lambda params: params.get("action_name") is not None),
    "reset_joints_within_limits_range": LabTerm(reset_joints_within_limits_range, _always),
    "command_resample": LabTerm(command_resample, _always),
    "fingers_contact_force_b": LabTerm(fingers_contact_force_b, _always),
    "action_l2_clamped": LabTerm(action_l2_clamped, _always),
    "action_rate_l2_clamped": LabTerm(action_rate_l2_clamped, _always),
}
"""Isaac Lab's name of a term -> its copy in this module, and the condition under which the copy is used."""
