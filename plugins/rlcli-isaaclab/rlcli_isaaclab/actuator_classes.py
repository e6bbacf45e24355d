"""Actuator models that compute joint efforts; a task may subclass them.

A task of Isaac Lab that imports a name from `isaaclab.actuators` gets the object of this name from here.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rlcli_isaaclab.utils.buffers import DelayBuffer
from rlcli_isaaclab.utils.string import resolve_matching_names_values
from rlcli_isaaclab.utils.types import ArticulationActions


class ActuatorBase:
    """Base class of actuator models, each for some joints of a robot in every environment."""

    is_implicit_model = False

    def __init__(
        self,
        cfg: Any,
        joint_names: list[str],
        joint_ids: Any,
        num_envs: int,
        device: Any,
        **defaults: Any,
    ) -> None:
        """Read the settings; `defaults` has values for settings that are None in the configuration."""
        self.cfg = cfg
        self.joint_names, self.joint_indices, self.num_joints = joint_names, joint_ids, len(joint_names)
        self._joint_names, self._joint_indices = joint_names, joint_ids
        self._num_envs, self._device = num_envs, device
        for name, default in _DEFAULTS.items():
            try:
                value = self._parse_joint_parameter(getattr(cfg, name, None), defaults.get(name, default))
            except ValueError as error:
                raise ValueError(f"setting '{name}' of an actuator: {error}") from None
            setattr(self, name, value)
        self.computed_effort = torch.zeros(num_envs, self.num_joints, device=device)
        self.applied_effort = torch.zeros_like(self.computed_effort)

    stiffness: Tensor
    damping: Tensor
    effort_limit: Tensor

    def reset(self, env_ids: Any) -> None:
        """Reset the actuator's state in some environments."""

    def compute(self, control_action: ArticulationActions, joint_pos: Tensor, joint_vel: Tensor) -> ArticulationActions:
        """Return the efforts for the next physics step, in a copy of the joints' targets (`control_action`).

        `joint_pos` and `joint_vel` are the state of the actuator's joints. (num_envs, joints)
        """
        raise NotImplementedError(f"class {type(self).__name__} has no method compute; implement it")

    def _parse_joint_parameter(self, cfg_value: Any, default_value: Any) -> Tensor:
        """Return the value of a setting for every joint. (num_envs, joints)

        `cfg_value` is a number or a mapping from regular expressions of joint names; None: `default_value`.
        """
        value = default_value if cfg_value is None else cfg_value
        if value is None:
            raise ValueError(
                f"actuator class {type(self).__name__}: _parse_joint_parameter received neither a value nor a default"
                " for a setting such as stiffness; give one of them a number"
            )
        found = torch.zeros(self._num_envs, self.num_joints, device=self._device)
        if isinstance(value, dict):
            columns, _, values = resolve_matching_names_values(value, self.joint_names)
            found[:, columns] = torch.tensor(values, dtype=torch.float32, device=self._device)
        else:
            found[:] = value
        return found

    def _clip_effort(self, effort: Tensor) -> Tensor:
        """Return efforts clipped to +-`effort_limit`. (num_envs, joints) [N or N m]"""
        return torch.clip(effort, -self.effort_limit, self.effort_limit)


_DEFAULTS = {
    **dict.fromkeys(("stiffness", "damping", "armature", "friction", "dynamic_friction", "viscous_friction"), 0.0),
    **dict.fromkeys(("effort_limit", "velocity_limit", "effort_limit_sim", "velocity_limit_sim"), torch.inf),
}
"""Setting of every actuator -> its default."""


class IdealPDActuator(ActuatorBase):
    """PD controller with a limit on the effort."""

    def compute(self, control_action: ArticulationActions, joint_pos: Tensor, joint_vel: Tensor) -> ArticulationActions:
        """Return the efforts of the controller [N or N m], within `effort_limit`."""
        position, velocity = control_action.joint_positions, control_action.joint_velocities
        effort = torch.zeros_like(joint_pos) if control_action.joint_efforts is None else control_action.joint_efforts
        effort = effort + self.stiffness * (joint_pos if position is None else position).sub(joint_pos)
        effort = effort + self.damping * (joint_vel if velocity is None else velocity).sub(joint_vel)
        self.computed_effort = effort
        self.applied_effort = self._clip_effort(effort)
        return ArticulationActions(joint_efforts=self.applied_effort, joint_indices=control_action.joint_indices)


class ImplicitActuator(IdealPDActuator):
    """PD controller, the base class of a task's subclasses of Isaac Lab's implicit actuator.

    In Isaac Lab PhysX integrates this drive. Here the subclass may change the targets in `compute`, and rlcli computes
    the effort before each physics step.
    """

    is_implicit_model = True


class DCMotor(IdealPDActuator):
    """A PD controller whose effort is limited by the motor's torque-speed curve."""

    velocity_limit: Tensor

    def __init__(self, cfg: Any, *args: Any, **defaults: Any) -> None:
        super().__init__(cfg, *args, **defaults)
        self._saturation_effort = cfg.saturation_effort
        self._joint_vel = torch.zeros_like(self.computed_effort)

    def compute(self, control_action: ArticulationActions, joint_pos: Tensor, joint_vel: Tensor) -> ArticulationActions:
        """Return the efforts of the controller [N or N m], within the torque-speed curve."""
        self._joint_vel[:] = joint_vel
        return super().compute(control_action, joint_pos, joint_vel)

    def _clip_effort(self, effort: Tensor) -> Tensor:
        corner = self.velocity_limit * (1.0 + self.effort_limit / self._saturation_effort)
        drop = self._joint_vel.clamp(-corner, corner) / self.velocity_limit
        low = torch.maximum(self._saturation_effort * (-1.0 - drop), -self.effort_limit)
        high = torch.minimum(self._saturation_effort * (1.0 - drop), self.effort_limit)
        return torch.clip(effort, low, high)


class DelayedPDActuator(IdealPDActuator):
    """A PD controller whose targets are delayed by some physics steps; each episode samples its delay."""

    def __init__(self, cfg: Any, *args: Any, **defaults: Any) -> None:
        super().__init__(cfg, *args, **defaults)
        delays = (DelayBuffer(cfg.max_delay, self._num_envs, self._device) for _ in range(3))
        self._delayed_positions, self._delayed_velocities, self._delayed_efforts = delays

    def reset(self, env_ids: Any) -> None:
        """Sample new delays in the environments `env_ids`, whose episodes begin; None: in all environments."""
        rows = torch.arange(self._num_envs, device=self._device)[slice(None) if env_ids is None else env_ids]
        lags = torch.randint(self.cfg.min_delay, self.cfg.max_delay + 1, (len(rows),), device=self._device)
        for delay in (self._delayed_positions, self._delayed_velocities, self._delayed_efforts):
            delay.set_time_lag(lags, rows)
            delay.reset(rows)

    def compute(self, control_action: ArticulationActions, joint_pos: Tensor, joint_vel: Tensor) -> ArticulationActions:
        """Return the efforts of the controller for the delayed targets [N or N m]."""
        pairs = (
            (self._delayed_positions, control_action.joint_positions),
            (self._delayed_velocities, control_action.joint_velocities),
            (self._delayed_efforts, control_action.joint_efforts),
        )
        late = [None if target is None else delay.compute(target) for delay, target in pairs]
        return super().compute(ArticulationActions(*late), joint_pos, joint_vel)


__all__ = ["ActuatorBase", "DCMotor", "DelayedPDActuator", "IdealPDActuator", "ImplicitActuator"]
