"""Base classes of action terms on joints, which turn columns of the policy's action into commands of actuators."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np
import torch
from torch import Tensor

from rlcli.managers.action import CommandMap
from rlcli.mdp.term import JointTerm
from rlcli.mdp.term_helpers import column_numbers
from rlcli.scene.joint_command import JointCommand
from rlcli.scene.names import match_values
from rlcli.task import Range


@dataclass(kw_only=True, eq=False)
class JointAction(JointTerm):
    """Base class of actions on joints: the columns of the action become one command for each of the `joints`."""

    actuator: ClassVar[str]
    """Kind of actuator that the scene adds to joints without one."""
    unit: ClassVar[str]
    """Unit of the command."""

    def __post_init__(self) -> None:
        columns = column_numbers(self.joints, len(self.entity.joint_names))
        self.elements = tuple(self.entity.joint_names[c] for c in columns)
        self._drive = JointCommand(self.entity, self.actuator, columns)
        self.sinks = self._drive.sinks
        self.actuators = self._drive.actuators
        """Id of the MuJoCo actuator of each joint; None where an actuator model computes the effort."""
        self.size = len(columns)
        self._clip: tuple[Tensor, Tensor] | None = None
        self.command = torch.zeros(self.env.num_envs, self.size, device=self.env.device)
        """Command after `clip`, before the limits of the actuators. (num_envs, joints)"""

    def process(self, action: Tensor) -> None:
        """Write the controls of this step. action (num_envs, size)"""
        self._compute_command(action)
        if self._clip is not None:
            self.command.clamp_(*self._clip)
        self._drive.write(self.command)

    def _compute_command(self, action: Tensor) -> None:
        """Compute the commands of all joints from the action and write them to `command`."""
        raise NotImplementedError

    def _per_joint(self, mapping: dict[str, float], default: float) -> Tensor:
        """Return a value for each joint from a mapping of names or patterns; `default` where none matches. (joints,)"""
        values = [default if v is None else v for v in match_values(mapping, self.elements, "joint")]
        return torch.tensor(values, dtype=torch.float32, device=self.env.device)

    def _number_or_per_joint(self, value: float | dict[str, float], default: float) -> float | Tensor:
        return self._per_joint(value, default) if isinstance(value, dict) else value


@dataclass(kw_only=True, eq=False)
class ScaledJointAction(JointAction):
    """Base class of joint actions with `scale` and `clip`: one value for all joints, or a mapping by joint."""

    scale: float | dict[str, float] = 1.0
    clip: Range | dict[str, Range] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._scale = self._number_or_per_joint(self.scale, 1.0)
        if self.clip is not None:
            ends = self.clip if isinstance(self.clip, dict) else {".*": self.clip}
            low = self._per_joint({pattern: pair[0] for pattern, pair in ends.items()}, -math.inf)
            high = self._per_joint({pattern: pair[1] for pattern, pair in ends.items()}, math.inf)
            self._clip = low, high


@dataclass(kw_only=True, eq=False)
class AffineJointAction(ScaledJointAction):
    """Base class of actions of the form action x scale + offset, which exported policies can contain as a formula."""

    offset: float | dict[str, float] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        # torch wraps a Python number into a tensor at each use, which takes as long as the product
        self._factor = torch.as_tensor(self._scale, dtype=torch.float32, device=self.env.device)
        self._offset = self._number_or_per_joint(self.offset, 0.0)
        self._limits = _command_limits(self.entity.engine.model, self.actuators, self.actuator)

    def command_map(self) -> CommandMap:
        """Return the formula of the commands, and the limits of the actuators."""
        scale, offset = (self._each(value) for value in (self._scale, self._offset))
        clip = None if self._clip is None else tuple(zip(*map(self._each, self._clip), strict=True))
        return CommandMap(scale, offset, clip, self._limits)

    def _compute_command(self, action: Tensor) -> None:
        torch.mul(action, self._factor, out=self.command)
        if isinstance(self._offset, Tensor) or self._offset:
            self.command += self._offset

    def _each(self, value: float | Tensor) -> tuple[float, ...]:
        """Return a setting, which is the same in all environments, as one number for each column."""
        if isinstance(value, Tensor):
            return tuple((value[0] if value.dim() == 2 else value).tolist())
        return (value,) * self.size


def _command_limits(model: mujoco.MjModel, actuators: list[int | None], kind: str) -> tuple[tuple[float, float], ...]:
    """Return the smallest and the largest effective command of each actuator.

    The limits follow from the control range; for motors also from the force limits of the actuator and of the joint.
    """
    limits = []
    for a in actuators:
        if a is None:  # an actuator model limits efforts, not commands
            limits.append((-math.inf, math.inf))
            continue
        gain, gear, joint = model.actuator_gainprm[a, 0], model.actuator_gear[a, 0], model.actuator_trnid[a, 0]
        low, high = model.actuator_ctrlrange[a] if model.actuator_ctrllimited[a] else (-math.inf, math.inf)
        if not gain or not gear:
            low, high = -math.inf, math.inf  # this actuator has no effect
        elif kind != "motor":
            low, high = sorted((low / gear, high / gear))
        else:
            if model.actuator_forcelimited[a]:
                low, high = _overlap((low, high), sorted(model.actuator_forcerange[a] / gain))
            # from here on in joint units: the joint's own force limit is in them
            low, high = sorted((low * gear, high * gear))
            alone = np.count_nonzero(model.actuator_trnid[:, 0] == joint) == 1
            if model.jnt_actfrclimited[joint] and alone:
                low, high = _overlap((low, high), sorted(model.jnt_actfrcrange[joint] / gain))
        limits.append((float(low), float(high)))
    return tuple(limits)


def _overlap(a: Sequence[float], b: Sequence[float]) -> tuple[float, float]:
    return max(a[0], b[0]), min(a[1], b[1])
