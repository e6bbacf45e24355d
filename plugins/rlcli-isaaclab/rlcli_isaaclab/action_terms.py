"""Action classes with Isaac Lab's interface: base classes of user actions, and actions that `rlcli.mdp` lacks."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from rlcli.scene.names import match_values
from rlcli_isaaclab.managers import ActionTerm
from rlcli_isaaclab.operational_space import OperationalSpaceControllerAction
from rlcli_isaaclab.term_counterparts import ACTIONS

_OWN = "rlcli_isaaclab"


class AffineActionTerm(ActionTerm):
    """Base class of actions of the form clip(action x scale + offset).

    scale, offset: a number, or a mapping from regular expressions of element names to numbers.
    """

    def __init__(self, cfg: Any, env: Any, names: list[str]) -> None:
        super().__init__(cfg, env)
        self._names = names
        self._raw_actions = torch.zeros(self.num_envs, len(names), device=self.device)
        self._processed_actions = torch.zeros_like(self._raw_actions)
        self._scale = self._by_name(cfg.scale, 1.0)
        self._offset = self._by_name(getattr(cfg, "offset", 0.0), 0.0)
        clip = dict(cfg.clip or {})
        low = self._by_name({key: pair[0] for key, pair in clip.items()}, -torch.inf)
        high = self._by_name({key: pair[1] for key, pair in clip.items()}, torch.inf)
        self._clip = torch.stack([low, high], dim=-1)

    def _by_name(self, value: Any, default: float) -> Tensor:
        """Return one value for each column of the action, from a number or a mapping. (num_envs, k)

        A mapping goes from regular expressions of element names to numbers; `default` is for names that none matches.
        """
        if isinstance(value, Mapping):
            found = match_values(value, self._names, "element") if value else [None] * len(self._names)
            row = torch.tensor([default if v is None else float(v) for v in found], device=self.device)
        else:
            row = torch.full((len(self._names),), float(value), device=self.device)
        return row.expand(self.num_envs, -1).clone()

    @property
    def action_dim(self) -> int:
        """Number of columns of the policy's action."""
        return len(self._names)

    @property
    def raw_actions(self) -> Tensor:
        """The policy's action for this term. (num_envs, k)"""
        return self._raw_actions

    @property
    def processed_actions(self) -> Tensor:
        """The action after scale, offset and clip. (num_envs, k)"""
        return self._processed_actions

    def process_actions(self, actions: Tensor) -> None:
        """Scale, shift and clip the action. (num_envs, k)"""
        self._raw_actions[:] = actions
        wanted = self._raw_actions * self._scale + self._offset
        self._processed_actions[:] = torch.clamp(wanted, self._clip[..., 0], self._clip[..., 1])

    def reset(self, env_ids: Any = None) -> None:
        """Set the raw actions of the environments `env_ids` to zero; None: of all environments."""
        self._raw_actions[slice(None) if env_ids is None else env_ids] = 0.0


class JointAction(AffineActionTerm):
    """Base class of actions on joints, for the user's subclasses.

    An action class of Isaac Lab itself is replaced by rlcli's built-in action instead.
    """

    def __init__(self, cfg: Any, env: Any) -> None:
        asset = env.scene[cfg.asset_name]
        self._joint_ids, self._joint_names = asset.find_joints(cfg.joint_names, preserve_order=cfg.preserve_order)
        self._num_joints = len(self._joint_ids)
        super().__init__(cfg, env, self._joint_names)


class JointPositionAction(JointAction):
    """Action whose columns are position targets of joints, after scale and offset [m or rad]."""

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(cfg, env)
        if cfg.use_default_offset:
            self._offset = self._asset.data.default_joint_pos[:, self._joint_ids].clone()

    def apply_actions(self) -> None:
        """Write the targets of the joints."""
        self._asset.set_joint_position_target(self.processed_actions, joint_ids=self._joint_ids)


class RelativeJointPositionAction(JointAction):
    """Action whose columns are added to the joint positions at each physics step, as position targets [m or rad]."""

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(cfg, env)
        if cfg.use_zero_offset:
            self._offset = torch.zeros_like(self._offset)

    def apply_actions(self) -> None:
        """Write the targets of the joints."""
        targets = self.processed_actions + self._asset.data.joint_pos[:, self._joint_ids]
        self._asset.set_joint_position_target(targets, joint_ids=self._joint_ids)


class JointVelocityAction(JointAction):
    """Action whose columns are velocity targets of joints, after scale and offset [m/s or rad/s]."""

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(cfg, env)
        if cfg.use_default_offset:
            self._offset = self._asset.data.default_joint_vel[:, self._joint_ids].clone()

    def apply_actions(self) -> None:
        """Write the targets of the joints."""
        self._asset.set_joint_velocity_target(self.processed_actions, joint_ids=self._joint_ids)


class JointEffortAction(JointAction):
    """Action whose columns are efforts of joint motors, after scale and offset [N or N m]."""

    def apply_actions(self) -> None:
        """Write the efforts of the joints."""
        self._asset.set_joint_effort_target(self.processed_actions, joint_ids=self._joint_ids)


class ThrustAction(AffineActionTerm):
    """Action whose columns are thrusts of the rotors of a `Multirotor` [N]."""

    def __init__(self, cfg: Any, env: Any) -> None:
        asset = env.scene[cfg.asset_name]
        patterns = asset.actuators["thrusters"].cfg.thruster_names_expr
        _, names = asset.find_bodies(patterns, preserve_order=cfg.preserve_order)
        self._thruster_ids = [asset.thruster_names.index(name) for name in names]
        super().__init__(cfg, env, names)
        if cfg.use_default_offset:
            # as in Isaac Lab, the default offset is the speed of the rotors [1/s], although the action is a thrust [N]
            self._offset = asset.data.default_thruster_rps[:, self._thruster_ids].clone()

    def apply_actions(self) -> None:
        """Write the thrust targets."""
        self._asset.set_thrust_target(self.processed_actions, thruster_ids=self._thruster_ids)


_LAB_ACTIONS: dict[str, type[ActionTerm]] = {
    kind.__name__: kind for kind in (OperationalSpaceControllerAction, RelativeJointPositionAction, ThrustAction)
}
"""Name of an action class of Isaac Lab -> class of this package that replaces it, because it acts in each physics step.

rlcli's built-in actions act only once per environment step.
"""


def find_action(class_type: Any) -> type[ActionTerm] | None:
    """Return the class that runs an action: the user's own or one of this package; None: a built-in action of rlcli.

    `class_type` is the setting of this name in the configuration of the action.
    """
    name = class_type.rpartition(":")[2].rpartition(".")[2] if isinstance(class_type, str) else ""
    if name in _LAB_ACTIONS:
        return _LAB_ACTIONS[name]
    if not (isinstance(class_type, type) and issubclass(class_type, ActionTerm)):
        return None
    is_core = class_type.__module__.startswith(_OWN) and class_type.__name__ in ACTIONS
    return None if is_core else class_type


def driven_by(action: type[ActionTerm] | None) -> str | None:
    """Return the kind of commands that an action class sends to joints, by its source code.

    The kind is `motor` for efforts, `velocity` for velocities, and None for all other commands.
    """
    if action is None:
        return None
    kinds = [kind for kind in action.__mro__ if issubclass(kind, ActionTerm) and kind is not ActionTerm]
    source = "\n".join(map(inspect.getsource, kinds))
    if "set_joint_effort_target" in source:
        return "motor"
    return "velocity" if "set_joint_velocity_target" in source else None
